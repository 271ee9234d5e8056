"""A case: the TOML schema key by key, the validated case in LPS mm and radians, and the entry frame.

It holds what the user wrote. What the named files contain is read in `anatomy` and `registration`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
