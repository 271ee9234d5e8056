"""The straight insertion as joint motion: the needle's flange pose, and the path of each branch along the needle.

Each function is followed by the compiled loops behind it: plain ones over plain arrays, for which an arm is its lengths
(d1, a2, a3, d4, d5, d6) in mm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.inverse_kinematics import (
    N_BRANCHES,
    TURN,
    fill_branches,
    inverse,
    missing_reach_mm,
    wrapped_angle,
)
from puncture_twin.planning.arm.kinematics import singular_terms, singularity
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.rigid import pose

MIN_SINGULARITY = 0.05
"""Each term of :class:`planning.arm.kinematics.Singularity` must exceed this over the whole insertion. For the wrist
that is 2.9 deg; joint speeds there are up to 20 times those of the best pose, and worse below."""

MAX_JOINT_STEP_RAD_PER_MM = 0.05
"""A joint that turns more per mm of insertion jumps: at 10 mm/s it would run at 0.5 rad/s."""

FULL_MARGIN_RAD = math.pi / 2
"""A joint this far or farther from its limits has the full margin of 1."""


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


def flange_at(line: NeedleLine, distance_mm: float) -> Floats:
    """T_base_flange (4, 4), mm, at roll 0 and a distance from the target."""
    return pose(line.R_base_flange, line.target + distance_mm * line.outward)


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
        _survey_line(model.lengths, model.joint_limits, *path, rolls, bounds, *filled)
    return found


@nb.njit(cache=True)
def _survey_line(lengths, limits, R, target, outward, distances, depths, rolls, bounds, stops, starts, margins, turns):  # type: ignore[no-untyped-def]  # numba infers
    """Every branch and roll of one direction, by kinematics alone.

    Args:
        lengths: The arm.
        limits: Shape (6, 2), rad.
        R: Shape (3, 3): the flange's rotation at roll 0.
        target: Shape (3,), mm.
        outward: Shape (3,), unit.
        distances: Shape (m,), mm: target to flange.
        depths: Shape (m,), mm, rising.
        rolls: Shape (r,), rad.
        bounds: Least of the singular terms; most that a joint may turn, rad/mm; distance from a limit that counts as 1,
            rad.
        stops: Shape (8,), filled: the index of the sample at which the path ends, -1: nowhere.
        starts: Shape (8, 6), filled: the configuration at the first distance, roll 0, rad.
        margins: Shape (8, r), filled: see :func:`reach_margin`; NaN where the path stops or leaves the limits.
        turns: Shape (8, r, 6), filled: what to add to the path at roll 0, rad: roll and whole turns.
    """
    at_least, fastest, full = bounds
    p, here, least = np.empty(3), np.empty((8, 6)), np.ones(8)
    before, lowest, highest, middle = np.empty((8, 6)), np.empty((8, 6)), np.empty((8, 6)), np.empty((8, 6))
    stops[:] = -1
    for k in range(len(distances)):
        for i in range(3):
            p[i] = target[i] + distances[k] * outward[i]
        fill_branches(lengths, R, p, here, np.int64(-1))
        if k == 0:
            starts[:], before[:], lowest[:], highest[:] = here, here, here, here
        for branch in range(8):
            if stops[branch] >= 0:
                continue
            q = here[branch]
            for joint in range(6):
                last = before[branch, joint]
                q[joint] = q[joint] if k == 0 else last + wrapped_angle(q[joint] - last)
            if k > 0 and _fast_joint(before[branch], q, depths[k] - depths[k - 1], fastest):
                stops[branch] = k - 1
                continue
            term = _least_term(lengths, q)
            if not term > at_least:
                stops[branch] = k
                continue
            least[branch] = min(least[branch], term)
            for joint in range(6):
                before[branch, joint] = q[joint]
                lowest[branch, joint] = min(lowest[branch, joint], q[joint])
                highest[branch, joint] = max(highest[branch, joint], q[joint])
                if k == len(distances) // 2:
                    middle[branch, joint] = q[joint]
    margins[:] = math.nan
    turns[:] = 0.0
    for branch in range(8):
        if stops[branch] < 0:
            reached = least[branch], lowest[branch], highest[branch], middle[branch]
            _rolled(limits, rolls, full, reached, margins[branch], turns[branch])


@nb.njit(cache=True)
def _fast_joint(before, after, mm, fastest):  # type: ignore[no-untyped-def]  # numba infers
    """Whether a joint turns more than ``fastest``, rad/mm, between two configurations (6,) that lie so far apart."""
    fast = False
    for joint in range(6):
        fast |= abs(after[joint] - before[joint]) / mm > fastest
    return fast


@nb.njit(cache=True)
def _least_term(lengths, q):  # type: ignore[no-untyped-def]  # numba infers
    shoulder, elbow, wrist = singular_terms(lengths, q[1], q[2], q[3], q[4])
    return min(shoulder, elbow, wrist) if not math.isnan(shoulder) else math.nan


@nb.njit(cache=True)
def _rolled(limits, rolls, full, reached, margins, turns):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``margins`` (r,) and ``turns`` (r, 6) of one branch.

    ``reached`` holds the least singular term of its path at roll 0, each joint's lowest and highest angle and those at
    its middle (6,), rad.
    """
    least, lowest, highest, middle = reached
    for i in range(len(rolls)):
        margin = least
        for joint in range(6):
            roll = rolls[i] if joint == 5 else 0.0
            low, high = limits[joint]
            at = middle[joint] + roll
            fewest, most = math.ceil((low - at) / TURN), math.floor((high - at) / TURN)
            turn = TURN * min(max(round(((low + high) / 2.0 - at) / TURN), fewest), most)
            turns[i, joint] = roll + turn
            below, above = lowest[joint] + (roll + turn) - low, high - (highest[joint] + (roll + turn))
            margin = min(margin, below / full, above / full)
        if margin >= 0.0:
            margins[i] = margin


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
    _every_branch(model.lengths, *line, distance_mm, q)
    return q


@nb.njit(cache=True)
def _every_branch(lengths, R, target, outward, distances, q):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``q`` (8, m, 6): every branch at each distance (m,) from the target, without jumps of whole turns.

    NaN from where a branch first does not exist.
    """
    p, here = np.empty(3), np.empty((8, 6))
    for k in range(len(distances)):
        for i in range(3):
            p[i] = target[i] + distances[k] * outward[i]
        fill_branches(lengths, R, p, here, np.int64(-1))
        for branch in range(8):
            for joint in range(6):
                angle = here[branch, joint]
                if k > 0:
                    before = q[branch, k - 1, joint]
                    angle = before + wrapped_angle(angle - before)  # NaN stays NaN
                q[branch, k, joint] = angle


@nb.njit(cache=True)
def fill_branch_path(lengths, R, target, outward, distances, branch, turn, q):  # type: ignore[no-untyped-def]  # numba infers
    """The path of one branch along the needle, without jumps of whole turns; NaN from where it first does not exist.

    Args:
        lengths: The arm.
        R: As in :class:`NeedleLine`.
        target: As in :class:`NeedleLine`, mm.
        outward: As in :class:`NeedleLine`.
        distances: Shape (m,), mm: target to flange along the path.
        branch: Index among the eight of ``inverse``.
        turn: Shape (6,), rad: added to every row, such as a roll and whole turns.
        q: Shape (m, 6), filled, rad.
    """
    p, here = np.empty(3), np.empty((8, 6))
    for k in range(len(distances)):
        for i in range(3):
            p[i] = target[i] + distances[k] * outward[i]
        fill_branches(lengths, R, p, here, branch)
        for joint in range(6):
            angle = here[branch, joint] + turn[joint]
            q[k, joint] = angle if k == 0 else q[k - 1, joint] + wrapped_angle(angle - q[k - 1, joint])


def away_from_singularities(model: UrModel, q: Floats) -> NDArray[np.bool_]:
    """Whether configurations (..., 6) keep their distance from every singularity; NaN does not. Shape (...)."""
    return np.asarray(singularity(model, q).least() > MIN_SINGULARITY)


class InsertionStop(NamedTuple):
    """Where a path along the needle ends, and why."""

    depth_mm: float
    detail: str


def first_stop(model: UrModel, path: Floats, depths_mm: Floats) -> InsertionStop | None:
    """Where a path stops being feasible: out of reach, at a singularity, or with a joint that jumps; None if nowhere.

    Args:
        model: The arm.
        path: Shape (m, 6), rad, one branch of :func:`every_branch`.
        depths_mm: Shape (m,), rising, mm.
    """
    at = _first_stop_at(model.lengths, path, depths_mm, MIN_SINGULARITY, MAX_JOINT_STEP_RAD_PER_MM)
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


@nb.njit(cache=True)
def _first_stop_at(lengths, path, depths, at_least, fastest):  # type: ignore[no-untyped-def]  # numba infers
    """Index at which a path ends: no solution, too near a singularity, or a joint faster than it may; -1: nowhere.

    Args:
        lengths: The arm.
        path: Shape (m, 6), rad.
        depths: Shape (m,), mm, rising.
        at_least: Least of the singular terms.
        fastest: rad/mm.
    """
    last = len(path) - 1
    for k in range(last + 1):
        if not _least_term(lengths, path[k]) > at_least:
            return k
        if k < last:
            for joint in range(6):
                if abs(path[k + 1, joint] - path[k, joint]) / (depths[k + 1] - depths[k]) > fastest:
                    return k
    return -1


def reach_margin(model: UrModel, q: Floats) -> float:
    """The least over a motion of each joint's distance to its limits over a quarter turn, and of the singularity terms.

    Args:
        model: The arm.
        q: Shape (m, 6), rad.

    Returns:
        0..1 for motions within the limits.
    """
    return float(_path_margin(model.lengths, model.joint_limits, FULL_MARGIN_RAD, q))


@nb.njit(cache=True)
def _path_margin(lengths, limits, full, path):  # type: ignore[no-untyped-def]  # numba infers
    """Least of the singular terms and of each joint's distance to its limits over ``full``, at most 1."""
    margin = 1.0
    for k in range(len(path)):
        margin = min(margin, _least_term(lengths, path[k]))
        for joint in range(6):
            to_limit = min(path[k, joint] - limits[joint, 0], limits[joint, 1] - path[k, joint])
            margin = min(margin, to_limit / full)
    return margin


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
