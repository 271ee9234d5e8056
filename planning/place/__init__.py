"""Where to put the arm: mounts about the patient, scored by the fraction of organ-safe directions that they reach."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
