"""Where to stand the arm."""
