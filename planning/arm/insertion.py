"""The straight insertion: its line, its joint motion, where a branch's path along the needle ends, and its margin.

Each function is followed by the compiled loop behind it: a plain one over plain arrays, for which an arm is its lengths
(d1, a2, a3, d4, d5, d6) in mm.
"""

import math
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import MIN_SINGULARITY, least_term, singularity
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import allocation_free


class NeedleLine(NamedTuple):
    """A line to insert along, base frame."""

    R_base_flange: Floats  # shape (3, 3): the flange's axes at roll 0
    target: Floats  # shape (3,), mm
    outward: Floats  # shape (3,), unit


def needle_lines(targets_base: Floats, outwards_base: Floats) -> list[NeedleLine]:
    """Lines through targets (n, 3), mm, outward along unit vectors (n, 3)."""
    rotations = np.ascontiguousarray(flange_poses(targets_base, outwards_base, 0.0)[:, :3, :3])
    return [NeedleLine(*row) for row in zip(rotations, targets_base, outwards_base, strict=True)]


def flange_poses(
    target_base: Floats, outward_base: Floats, distance_mm: Floats | float, roll: Floats | float = 0.0
) -> Floats:
    """Flange poses that point the needle at the target from a distance.

    At roll 0 the flange's x axis is, of the three base axes, the one farthest from the needle, made square to it.

    Args:
        target_base: Shape (3,) or (n, 3), mm.
        outward_base: Shape (3,) or (n, 3), unit. The flange's z axis is its opposite.
        distance_mm: Target to flange; a number or (n,).
        roll: Turn of the flange about its z axis, rad; a number or (n,).

    Returns:
        T_base_flange, shape (n, 4, 4), mm.
    """
    outward, target, distance, turn = np.broadcast_arrays(
        *(np.atleast_2d(a) for a in (outward_base, target_base)),
        *(np.atleast_1d(a)[:, None] for a in (distance_mm, roll)),
    )
    z = -outward
    reference = np.eye(3)[np.argmin(np.abs(z), axis=1)]
    x = reference - np.sum(reference * z, axis=1, keepdims=True) * z
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(z, x)
    T = np.zeros((len(z), 4, 4))
    T[:, :3, 0] = np.cos(turn) * x + np.sin(turn) * y
    T[:, :3, 1] = np.cos(turn) * y - np.sin(turn) * x
    T[:, :3, 2] = z
    T[:, :3, 3] = target + distance * outward
    T[:, 3, 3] = 1.0
    return T


MAX_JOINT_STEP_RAD_PER_MM = 0.05
"""A joint that turns more per mm of insertion jumps: at 10 mm/s it would run at 0.5 rad/s."""
FULL_MARGIN_RAD = math.pi / 2
"""A joint this far or farther from its limits has the full margin of 1."""


class InsertionStop(NamedTuple):
    """End of a path along the needle, and its reason."""

    depth_mm: float
    detail: str


def first_stop(model: UrModel, path: Floats, depths_mm: Floats) -> InsertionStop | None:
    """First sample at which a path is not feasible: out of reach, singular, or a joint jumps; None if none.

    Of one branch (m, 6), rad, at rising depths (m,), mm.
    """
    at = _first_stop_at(model.lengths, path, depths_mm, MIN_SINGULARITY, MAX_JOINT_STEP_RAD_PER_MM)
    if at < 0:
        return None
    far = singularity(model, path[at])
    if np.isnan(path[at, 0]):
        what = "the arm cannot reach further"
    elif far.least() > MIN_SINGULARITY:
        what = "a joint would jump"
    else:
        what = f"too near the {far.nearest} singularity"
    return InsertionStop(float(depths_mm[at]), f"{what} {depths_mm[at]:.1f} mm after the standoff")


@allocation_free()
def _first_stop_at(lengths, path, depths, at_least, fastest):  # type: ignore[no-untyped-def]  # numba infers
    """Index at which a path (m, 6), rad, ends: no solution, near a singularity, or a joint too fast; -1: nowhere."""
    last = len(path) - 1
    for k in range(last + 1):
        if not least_term(lengths, path[k]) > at_least:
            return k
        if k < last:
            for joint in range(6):
                if abs(path[k + 1, joint] - path[k, joint]) / (depths[k + 1] - depths[k]) > fastest:
                    return k
    return -1


def reach_margin(model: UrModel, q: Floats) -> float:
    """Margin of a motion (m, 6), rad, 0..1 within the limits.

    The least of each joint's distance to its limits over a quarter turn, and of the singularity terms.
    """
    return float(_path_margin(model.lengths, model.joint_limits, FULL_MARGIN_RAD, q))


@allocation_free()
def _path_margin(lengths, limits, full, path):  # type: ignore[no-untyped-def]  # numba infers
    """Least of the singular terms and of each joint's distance to its limits over ``full``, at most 1."""
    margin = 1.0
    for k in range(len(path)):
        margin = min(margin, least_term(lengths, path[k]))
        for joint in range(6):
            to_limit = min(path[k, joint] - limits[joint, 0], limits[joint, 1] - path[k, joint])
            margin = min(margin, to_limit / full)
    return margin
