"""The planner: decides which needle paths are safe and reachable. Pure: no simulator, no screen, no printing."""
