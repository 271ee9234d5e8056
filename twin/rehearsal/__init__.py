"""A plan executed in the twin, and what it says: where the tip ended, what was touched."""
