"""How far from the skin the tip waits before the insertion, for a case that does not say."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.settings import Needle
from puncture_twin.planning.collision.workcell import ARM_PADDING_MM

UNEVEN_SKIN_MM = 1.0
"""Added along the needle because skin is not flat and its triangles are coarser than it. On the embedded abdomen and
on two label maps of a real CT 0 and 0.1 mm leave the needle too near in up to 10 % of the organ-safe solid angle, 1 mm
in none of it."""

MAX_GAP_MM = 200.0
"""Along a path that grazes the skin no gap suffices; none is larger than the largest that a case may ask for."""


def skin_gaps(needle: Needle, skin_angle: Floats | float) -> Floats:
    """Distance along the needle from the waiting tip to the skin, for a case that states no standoff.

    The arm's checker keeps its padding p from the skin: about the needle (radius r) it sees a cylinder of radius r + p
    that begins p before the tip. At an angle a to the normal of flat skin, the rim of that cylinder's end lies
    (gap - p) cos(a) - (r + p) sin(a) above it, which is positive for gap > p + (r + p) tan(a).

    Args:
        needle: With ``skin_gap_mm``, the least gap.
        skin_angle: Any shape, rad, 0 straight in; NaN without a skin entry.

    Returns:
        Shape of ``skin_angle``, mm; NaN where that is.
    """
    slope = np.tan(np.asarray(skin_angle, dtype=float))
    clear = ARM_PADDING_MM + (needle.radius_mm + ARM_PADDING_MM) * slope + UNEVEN_SKIN_MM
    return np.asarray(np.clip(clear, needle.skin_gap_mm, max(MAX_GAP_MM, needle.skin_gap_mm)))
