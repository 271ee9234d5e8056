"""Compiled proofs of contact and of clearance: convex hulls, bounding spheres, and straight joint segments."""
