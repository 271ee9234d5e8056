"""How far from the target the needle's axis is checked: up to where the flange ends, or can be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.settings import Needle
from puncture_twin.planning.reach.skin_gap import skin_gaps


def farthest_flange(needle: Needle, max_skin_angle: float) -> float:
    """How far from the target, along the needle, the flange can be while the tip waits at any standoff, mm.

    Args:
        needle: The needle.
        max_skin_angle: The steepest angle at the skin that a case allows, rad.
    """
    if needle.standoff_mm is not None:
        return needle.length_mm + needle.standoff_mm
    return needle.length_mm + needle.shaft_mm + float(skin_gaps(needle, max_skin_angle))


def axis_lengths(case: Case, structures: Sequence[Structure]) -> Floats:
    """How far from the target the needle's axis is checked against each structure, shape (k,), mm.

    Against the body's structures up to where the flange ends; against what is outside of the body up to where the
    flange can be while the tip waits at its standoff.
    """
    farthest = farthest_flange(case.needle, case.search.max_skin_angle)
    return np.array([farthest if s.outside else case.needle.length_mm for s in structures], dtype=np.float64)
