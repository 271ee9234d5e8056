"""The straight insertion as joint motion: the needle's flange pose, and the path of each branch along the needle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm import kernels
from puncture_twin.planning.arm.kinematics import N_BRANCHES, inverse, missing_reach_mm, singularity
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import pose

MIN_SINGULARITY = 0.05
"""Each term of :class:`planning.arm.kinematics.Singularity` must exceed this over the whole insertion. For the wrist
that is 2.9 deg; joint speeds there are up to 20 times those of the best pose, and worse below."""

MAX_JOINT_STEP_RAD_PER_MM = 0.05
"""A joint that turns more per mm of insertion jumps: at 10 mm/s it would run at 0.5 rad/s."""

FULL_MARGIN_RAD = math.pi / 2
"""A joint this far or farther from its limits has the full margin of 1."""


class InsertionStop(NamedTuple):
    """Where a path along the needle ends, and why."""

    depth_mm: float
    detail: str


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


def away_from_singularities(model: UrModel, q: Floats) -> NDArray[np.bool_]:
    """Whether configurations (..., 6) keep their distance from every singularity; NaN does not. Shape (...)."""
    return np.asarray(singularity(model, q).least() > MIN_SINGULARITY)


def first_stop(model: UrModel, path: Floats, depths_mm: Floats) -> InsertionStop | None:
    """Where a path stops being feasible: out of reach, at a singularity, or with a joint that jumps; None if nowhere.

    Args:
        model: The arm.
        path: Shape (m, 6), rad, one branch of :func:`every_branch`.
        depths_mm: Shape (m,), rising, mm.
    """
    at = kernels.first_stop_at(model.lengths, path, depths_mm, MIN_SINGULARITY, MAX_JOINT_STEP_RAD_PER_MM)
    if at < 0:
        return None
    far = singularity(model, path[at])
    if np.isnan(path[at, 0]):
        what = "the arm does not reach on"
    elif far.least() > MIN_SINGULARITY:
        what = "a joint would jump"
    else:
        what = f"too near the {far.nearest} singularity"
    return InsertionStop(float(depths_mm[at]), f"{what} {depths_mm[at]:.1f} mm after the standoff")


def reach_margin(model: UrModel, q: Floats) -> float:
    """The least over a motion of each joint's distance to its limits over a quarter turn, and of the singularity terms.

    Args:
        model: The arm.
        q: Shape (m, 6), rad.

    Returns:
        0..1 for motions within the limits.
    """
    return float(kernels.path_margin(model.lengths, model.joint_limits, FULL_MARGIN_RAD, q))


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


class NeedleLine(NamedTuple):
    """A line to insert along, base frame."""

    R_base_flange: Floats
    """Shape (3, 3): the flange's axes at roll 0."""
    target: Floats
    """Shape (3,), mm."""
    outward: Floats
    """Shape (3,), unit."""


def needle_lines(targets_base: Floats, outwards_base: Floats) -> list[NeedleLine]:
    """Lines through targets (n, 3), mm, outward along unit vectors (n, 3)."""
    rotations = np.ascontiguousarray(flange_poses(targets_base, outwards_base, 0.0)[:, :3, :3])
    return [NeedleLine(*row) for row in zip(rotations, targets_base, outwards_base, strict=True)]


def flange_at(line: NeedleLine, distance_mm: float) -> Floats:
    """T_base_flange (4, 4), mm, at roll 0 and a distance from the target."""
    return pose(line.R_base_flange, line.target + distance_mm * line.outward)


def every_branch(model: UrModel, line: NeedleLine, distance_mm: Floats) -> Floats:
    """Every branch's path along the needle at roll 0. A roll adds to q6 and to nothing else.

    Args:
        model: The arm.
        line: The needle's line.
        distance_mm: Shape (m,): target to flange along the path.

    Returns:
        Shape (8, m, 6), rad, without jumps of whole turns; NaN from where a branch first does not exist.
    """
    q = np.empty((N_BRANCHES, len(distance_mm), 6))
    kernels.every_branch(model.lengths, *line, distance_mm, q)
    return q


def branch_path(model: UrModel, line: NeedleLine, distance_mm: Floats, branch: int, turn: Floats) -> Floats:
    """The path of one branch along the needle.

    Args:
        model: The arm.
        line: The needle's line.
        distance_mm: Shape (m,): target to flange along the path.
        branch: Index among the eight of ``inverse``.
        turn: Shape (6,), rad: added to every row, such as a roll and whole turns.

    Returns:
        Shape (m, 6), rad, without jumps of whole turns; NaN from where the branch first does not exist.
    """
    q = np.empty((len(distance_mm), 6))
    kernels.branch_path(model.lengths, *line, distance_mm, branch, turn, q)
    return q


class Survey(NamedTuple):
    """What kinematics alone says of many directions, every branch and roll."""

    stop_at: NDArray[np.int64]
    """Shape (n, 8): index of the sample at which the path ends, -1 where it reaches the target."""
    starts: Floats
    """Shape (n, 8, 6), rad: each path's first configuration at roll 0; NaN where there is none."""
    margins: Floats
    """Shape (n, 8, r): see :func:`reach_margin`; NaN where the path ends early or leaves the joint limits."""
    turns: Floats
    """Shape (n, 8, r, 6), rad: what to add to the path at roll 0, the roll and whole turns."""


def survey(
    model: UrModel,
    lines: Sequence[NeedleLine],
    distances_mm: Sequence[Floats],
    depths_mm: Sequence[Floats],
    rolls: Floats,
) -> Survey:
    """Every branch and roll of many straight insertions, each turned as far from the joint limits as whole turns allow.

    Args:
        model: The arm.
        lines: The n directions.
        distances_mm: For each direction, shape (m,): target to flange at the samples of the path.
        depths_mm: The same as depths, rising, shape (m,).
        rolls: Shape (r,), rad.
    """
    count = len(lines)
    found = Survey(
        np.empty((count, N_BRANCHES), np.int64),
        np.empty((count, N_BRANCHES, 6)),
        np.empty((count, N_BRANCHES, len(rolls))),
        np.empty((count, N_BRANCHES, len(rolls), 6)),
    )
    bounds = (MIN_SINGULARITY, MAX_JOINT_STEP_RAD_PER_MM, FULL_MARGIN_RAD)
    for i in range(count):
        filled = (found.stop_at[i], found.starts[i], found.margins[i], found.turns[i])
        path = (*lines[i], distances_mm[i], depths_mm[i])
        kernels.survey(model.lengths, model.joint_limits, *path, rolls, bounds, *filled)
    return found
