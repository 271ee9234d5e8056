"""How the arm moves: OMPL's approach from home to standoff, timing within limits, and the check of a finished path."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
