"""The map between the grid points: cells of directions proven safe or rejected, the proof as a file, its checker.

The checker (`checker`, `plain_skin`) shares no code with the search or with what makes the certificate.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
