"""The straight insertion as joint motion: the needle's flange pose, and the way of each branch along the needle."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.robot.kinematics import inverse, missing_reach_mm, singularity, wrap_to_pi
from planning.robot.ur import UrModel

Array = NDArray[np.float64]

MIN_SINGULARITY = 0.05
"""Each term of :class:`planning.robot.kinematics.Singularity` must exceed this over the whole insertion. For the wrist
that is 2.9 deg; joint speeds there are up to 20 times those of the best pose, and worse below."""

MAX_JOINT_STEP_RAD_PER_MM = 0.05
"""A joint that turns more per mm of insertion jumps: at 10 mm/s it would run at 0.5 rad/s."""

FULL_MARGIN_RAD = math.pi / 2
"""A joint this far or farther from its limits has the full margin of 1."""


class Stop(NamedTuple):
    """Where a way along the needle ends, and why."""

    depth_mm: float
    detail: str


def flange_poses(
    target_base: Array, outward_base: Array, distance_mm: Array | float, roll: Array | float = 0.0
) -> Array:
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


def insertion_paths(model: UrModel, target_base: Array, outward_base: Array, distance_mm: Array) -> Array:
    """Every branch's way along the needle at roll 0. A roll adds to q6 and to nothing else.

    Args:
        model: The arm.
        target_base: Shape (3,), mm.
        outward_base: Shape (3,), unit.
        distance_mm: Shape (m,): target to flange along the way.

    Returns:
        Shape (8, m, 6), rad, without jumps of whole turns; NaN from where a branch first does not exist.
    """
    q = np.swapaxes(inverse(model, flange_poses(target_base, outward_base, distance_mm)), 0, 1)
    steps = wrap_to_pi(np.diff(q, axis=1))
    return np.concatenate([q[:, :1], q[:, :1] + np.cumsum(steps, axis=1)], axis=1)


def away_from_singularities(model: UrModel, q: Array, at_least: float = MIN_SINGULARITY) -> NDArray[np.bool_]:
    """Whether configurations (..., 6) keep their distance from every singularity; NaN does not. Shape (...)."""
    return np.asarray(singularity(model, q).least() > at_least)


def first_stop(model: UrModel, path: Array, depths_mm: Array) -> Stop | None:
    """Where a way stops being drivable: out of reach, at a singularity, or with a joint that jumps; None if nowhere.

    Args:
        model: The arm.
        path: Shape (m, 6), rad, one branch of :func:`insertion_paths`.
        depths_mm: Shape (m,), rising, mm.
    """
    far = singularity(model, path)
    per_mm = np.abs(np.diff(path, axis=0)).max(axis=1) / np.diff(depths_mm)
    jumps = np.append(per_mm > MAX_JOINT_STEP_RAD_PER_MM, False)
    stops = ~(far.least() > MIN_SINGULARITY) | jumps
    if not stops.any():
        return None
    at = int(np.argmax(stops))
    if np.isnan(path[at, 0]):
        what = "the arm does not reach on"
    elif far.least()[at] > MIN_SINGULARITY:
        what = "a joint would jump"
    else:
        what = f"too near the {min(far._fields, key=lambda name: getattr(far, name)[at])} singularity"
    return Stop(float(depths_mm[at]), f"{what} {depths_mm[at]:.1f} mm after the standoff")


def reach_margin(model: UrModel, q: Array) -> float:
    """The least over a motion of each joint's distance to its limits over a quarter turn, and of the singularity terms.

    Args:
        model: The arm.
        q: Shape (m, 6), rad.

    Returns:
        0..1 for motions within the limits.
    """
    to_limits = np.minimum(q - model.joint_limits[:, 0], model.joint_limits[:, 1] - q).min()
    return float(min(1.0, to_limits / FULL_MARGIN_RAD, singularity(model, q).least().min()))


def why_unreachable(model: UrModel, T_base_flange: Array) -> str:
    """What keeps every branch from one flange pose (4, 4), in mm: one sentence for people."""
    stands = (
        f"the flange would stand {np.linalg.norm(T_base_flange[:3, 3] - model.shoulder_base):.1f} mm from the shoulder"
    )
    missing = float(missing_reach_mm(model, T_base_flange)[0])
    if math.isinf(missing):
        return f"{stands}, its wrist too close to the base's axis for any shoulder angle"
    if missing > 0.0:
        return f"{stands}, {missing:.1f} mm out of the arm's reach in this direction"
    far = singularity(model, inverse(model, T_base_flange)[0])
    best = int(np.nanargmax(far.least()))
    name = min(far._fields, key=lambda field: getattr(far, field)[best])
    return f"{stands}, too near the {name} singularity ({far.least()[best]:.3f}, at least {MIN_SINGULARITY})"
