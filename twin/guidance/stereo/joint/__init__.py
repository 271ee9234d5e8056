"""Joint estimate of all that a session measured, and its predictions of ball, target and needle."""
