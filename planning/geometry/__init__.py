"""Triangle meshes and what follows from them alone: crossings, containment, winding, creases, decimation, voxels.

Rigid motions, least squares, spaces (LPS, RAS) and units are here too. Nothing here knows what a mesh means to a
patient or to an arm.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
