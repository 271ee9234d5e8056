"""Mesh files: STL, OBJ, PLY, GLB and VTP, each by a reader of its own, behind `parse_mesh`."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
