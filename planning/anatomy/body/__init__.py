"""Which voxels of a CT are the patient, and what else is in it that is not air: limbs, table, mattress, lines."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
