"""Bodies with known truth: the carton of Chen 2019, an abdomen, an open head, and a supine patient as a CT.

``python -m puncture_twin.twin.phantoms --out DIR`` makes the embedded cases' files again.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
