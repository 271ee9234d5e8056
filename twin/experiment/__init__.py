"""The experiment of Chen et al. 2019 drawn anew: what its printed numbers say of its errors, and what they do not.

Arithmetic on points alone; what a robot and a scanner do lives in the plant.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
