"""How the arm moves: OMPL's approach from home to standoff, timing within limits, and the check of a finished path."""
