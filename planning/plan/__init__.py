"""The chosen pose and its motion: found from ranked candidates, written as `plan.json`, checked again when loaded."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
