"""What residuals cannot show of markers: permuted names, slipped axes, markers off the skin, a CT out of square.

It doubts a registration and never changes one.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
