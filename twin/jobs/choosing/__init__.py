"""Choosing among directions: two side by side, lists checked row by row, tables of candidates for other programs.

They read a search and change no verdict.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
