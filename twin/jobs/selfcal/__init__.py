"""The command ``selfcal``: the self-calibration from end to end, its pictures and page."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
