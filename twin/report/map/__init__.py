"""The map of all entry directions with the reason of each refusal, and the map of placements."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
