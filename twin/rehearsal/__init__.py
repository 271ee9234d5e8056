"""A plan executed in the twin, and its results: where the tip ended, what was touched."""
