"""What to prefer among safe directions: how far each may be off, their connected windows, and what a person chooses.

It reads candidates and changes no verdict.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
