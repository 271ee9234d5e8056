"""The command ``servo``, its pictures and page, and the tables of Liu 2007."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
