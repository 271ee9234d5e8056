"""The headless planner as a server: OpenIGTLink's messages, the sockets, and what is answered."""
