"""Guidance by CT: what is read off a scan. Markers, a lesion, a needle; from voxels alone, never from the plant."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
