"""B-mode pictures: speckle and needle as a probe shows them, and the needle detected in them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
