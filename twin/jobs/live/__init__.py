"""Live commands: the planner as an OpenIGTLink server, and the mirror, which only reads."""
