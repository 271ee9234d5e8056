"""Clearance of every needle axis from every structure: the exact engine, and FCL as the reference that it must equal.

Margins and verdicts are not known here.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
