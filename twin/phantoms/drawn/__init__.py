"""Trunks drawn anew by a seed: a case of meshes, no two alike, whose truth is known.

``python -m puncture_twin.twin.phantoms --out DIR --seed N`` writes one.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
