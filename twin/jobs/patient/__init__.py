"""The commands about a patient: search, check, plan, rehearse, export, register, verify, place."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
