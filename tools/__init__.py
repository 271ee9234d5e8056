"""What makes the project's own files, breaks its modules on purpose, and attacks it; nothing here is installed."""
