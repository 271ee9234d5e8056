"""From declared errors to chances: the covariance of the needle's pose, the chance to hit and the chances to touch.

It knows the arm and the registration, and draws nothing at random; what draws the truth lives in the twin.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
