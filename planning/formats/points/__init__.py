"""Named points: CSV, and 3D Slicer's markups and fiducial lists."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
