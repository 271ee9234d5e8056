"""What makes the project's own files; nothing here is installed."""
