"""Compiled proofs of contact and of clearance: convex hulls, bounding spheres, and straight joint segments."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
