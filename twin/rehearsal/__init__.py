"""A plan executed in the twin, and what it says: where the tip ended, what was touched."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
