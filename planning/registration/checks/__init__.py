"""What residuals cannot show of markers: permuted names, slipped axes, markers off the skin, a CT out of square.

And what a stated transform, which has no residuals, is held against.

It doubts a registration and never changes one.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
