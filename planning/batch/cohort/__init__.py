"""What a cohort is made of: a folder, a CSV, or a TOML file with patterns and grids of options; cases stay unread."""
