"""Planner and digital twin for robotic needle puncture: safe entry angles, reach, motion, rehearsal.

The functions are documented in `puncture_twin.api`; what they return, in the rooms of `puncture_twin.planning` and
`puncture_twin.twin`. Importing this loads nothing heavy and changes nothing. Research software, not a medical device.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
