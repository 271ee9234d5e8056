"""How the markers are touched with the needle's tip: which poses, in which order, by which motions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
