"""The exact engine's compiled inside: packed surfaces, bounds that are proofs, and triangle distances in float64."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
