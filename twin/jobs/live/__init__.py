"""What follows an arm or a tracked needle: the planner as an OpenIGTLink server, and the mirror, which only reads."""
