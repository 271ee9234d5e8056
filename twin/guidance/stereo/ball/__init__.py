"""The ball on the tool in a picture: rendered, found, and measured to a hundredth of a pixel."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
