"""The scene as a picture and as a film: patient, corridor of safe directions, needle and arm."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
