"""Slices of the CT about a needle's path, with outlines, margin and region: the picture and its parts."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
