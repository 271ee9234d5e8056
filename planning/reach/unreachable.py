"""What keeps every branch of the arm from a flange pose."""

from __future__ import annotations

import math

import numpy as np

from puncture_twin.planning.arm.inverse_kinematics import inverse, pan_angle, wrist_angles
from puncture_twin.planning.arm.singularity import MIN_SINGULARITY, singularity
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import allocation_free


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


def missing_reach_mm(model: UrModel, T_base_flange: Floats) -> Floats:
    """By how much upper arm and forearm are too short (or too long, folded) to reach each flange pose.

    Args:
        model: The arm.
        T_base_flange: Shape (n, 4, 4), mm.

    Returns:
        Shape (n,), mm: the least over all branches; 0 where a solution exists; infinite where no branch can turn its
        wrist so, because the wrist centre stands inside the cylinder of radius d4 about axis 1.
    """
    poses = np.array(T_base_flange, dtype=np.float64, order="C").reshape(-1, 4, 4)
    missing = np.empty(len(poses))
    _missing_reach(model.lengths, poses, missing)
    return missing


@allocation_free()
def _missing_reach(lengths, T, missing):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``missing`` (n,) in mm: how far upper arm and forearm are too short or too long for ``T`` (n, 4, 4)."""
    upper, fore, d6 = abs(lengths[1]), abs(lengths[2]), lengths[5]
    for row in range(len(T)):
        R, p = T[row, :3, :3], T[row, :3, 3]
        missing[row] = math.inf
        for side in (1.0, -1.0):
            q1 = pan_angle(lengths, p[0] - d6 * R[0, 2], p[1] - d6 * R[1, 2], side)
            if math.isnan(q1):
                continue
            for flip in (1.0, -1.0):
                _, _, _, x, y = wrist_angles(lengths, R, p, math.cos(q1), math.sin(q1), flip)
                far = math.sqrt(x * x + y * y)
                missing[row] = min(missing[row], max(far - (upper + fore), abs(upper - fore) - far, 0.0))
