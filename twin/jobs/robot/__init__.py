"""The commands about a real robot: mirror, which only reads."""
