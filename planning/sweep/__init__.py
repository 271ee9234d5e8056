"""Omnidirectional pointing: the needle rotated about the target from outside the body, as one motion."""
