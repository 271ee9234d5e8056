"""Label maps: which number is which organ, by file or by TotalSegmentator's lists, and a label's surface."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
