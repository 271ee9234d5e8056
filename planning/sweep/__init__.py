"""Omnidirectional pointing: the needle turned about the target from outside the body, as one motion."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
