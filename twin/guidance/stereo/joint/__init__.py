"""Everything that a session measured, estimated at once, and what that says of ball, target and needle."""
