"""Lines, areas and words in pictures without axes, smooth at their edges: nobody waits for a plotter to load."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
