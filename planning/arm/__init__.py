"""UR arms as drawn: dimensions, kinematics, link meshes, the tool, a CT gantry, the straight insertion.

Whether an arm touches anything is tested in `collision`, whether it can reach a direction in `reach`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
