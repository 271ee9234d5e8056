"""Cohorts: many cases planned, run in parts by workers that may die, merged into one table, and compared.

A case is a pure function into a folder that is named by the hash of its inputs, options and version, and appears whole.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
