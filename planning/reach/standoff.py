"""How far from the target the tip waits before the insertion: just outside the skin, or where the case says."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.settings import Needle
from puncture_twin.planning.reach.skin_gap import skin_gaps


def standoffs(needle: Needle, path_length: Floats | float, skin_angle: Floats | float) -> Floats:
    """Distance tip to target before the insertion: the case's, or just so that the needle clears the skin; mm.

    Args:
        needle: The needle.
        path_length: Target to skin, mm; NaN without a skin entry.
        skin_angle: The same shape, rad.
    """
    path_length = np.asarray(path_length, dtype=float)
    if needle.standoff_mm is None:
        return path_length + skin_gaps(needle, skin_angle)
    return np.full(path_length.shape, needle.standoff_mm)


def waiting_flange(needle: Needle, path_length: Floats | float, skin_angle: Floats | float) -> Floats:
    """How far from the target, along the needle, the flange is while the tip waits; see `standoffs`; mm."""
    return np.asarray(needle.length_mm + standoffs(needle, path_length, skin_angle))
