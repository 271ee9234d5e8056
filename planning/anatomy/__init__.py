"""The patient: structures with roles and margins, the skin, where a path crosses it, and what the CT shows beside.

Distances of needles from structures are measured in `clearance`; whether a candidate is safe is decided in `search`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
