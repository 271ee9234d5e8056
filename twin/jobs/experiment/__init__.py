"""The commands of an experiment, each with the truth beside what is measured: scan, touch.

A job composes plant and guidance: the device measures, guidance reads, and the job alone compares both with the truth.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
