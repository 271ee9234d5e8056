"""Planner and digital twin for robotic needle puncture: safe entry angles, reach, motion, rehearsal.

The functions are documented in `puncture_twin.api`; what they return, in the rooms of `puncture_twin.planning` and
`puncture_twin.twin`. Importing this loads nothing heavy and changes nothing. Research software, not a medical device.
"""

from pathlib import Path

import lazy_loader

_planning = Path(__file__).with_name("planning")
if _planning.is_symlink() or not _planning.is_dir():  # a checkout: the parts are beside this folder, not in it
    __path__.insert(0, str(_planning.parents[1]))

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
