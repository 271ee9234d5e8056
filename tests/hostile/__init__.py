"""Hostile inputs: made here, told in cases.toml, and run in a process with bounds."""
