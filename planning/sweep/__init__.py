"""Omnidirectional pointing: the needle turned about the target from outside the body, as one motion."""
