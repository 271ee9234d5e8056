"""Many cases, one after the other or in processes; one that fails does not stop the others."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
