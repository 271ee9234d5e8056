"""What the bending of a needle takes away from safe directions, and what a needle feels and does on one path.

The bound is kept as clearance beside every margin; the path and the force of one direction are for people to read.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
