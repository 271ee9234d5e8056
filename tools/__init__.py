"""What makes the project's own files, what breaks its modules on purpose, and what attacks it; nothing here is installed."""
