"""Pictures without a screen: a camera, triangles to samples, translucent surfaces, shading; compiled."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
