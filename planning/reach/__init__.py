"""Which candidates the arm can reach: a standoff pose and a straight insertion, free of contacts and singularities."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
