"""Volumes: NIfTI and NRRD, with headers that are checked before any voxel is inflated, in one orientation."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
