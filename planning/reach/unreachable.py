"""What keeps every branch of the arm from a flange pose."""

from __future__ import annotations

import math

import numpy as np

from puncture_twin.planning.arm.inverse_kinematics import inverse, missing_reach_mm
from puncture_twin.planning.arm.singularity import MIN_SINGULARITY, singularity
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats


def why_unreachable(model: UrModel, T_base_flange: Floats) -> str:
    """What keeps every branch from one flange pose (4, 4), in mm: one sentence for people."""
    place = (
        f"the flange would stand {np.linalg.norm(T_base_flange[:3, 3] - model.shoulder_base):.1f} mm from the shoulder"
    )
    missing = float(missing_reach_mm(model, T_base_flange)[0])
    if math.isinf(missing):
        return f"{place}, its wrist too close to the base's axis for any shoulder angle"
    if missing > 0.0:
        return f"{place}, {missing:.1f} mm out of the arm's reach in this direction"
    solutions = inverse(model, T_base_flange)[0]
    best = singularity(model, solutions[np.nanargmax(singularity(model, solutions).least())])
    return f"{place}, too near the {best.nearest} singularity ({best.least():.3f}, at least {MIN_SINGULARITY})"
