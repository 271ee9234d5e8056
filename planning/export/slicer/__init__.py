"""What 3D Slicer opens: a path, markers, the safe entry area on the skin, the CT-to-robot transform, a scene."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
