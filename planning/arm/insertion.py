"""Kinematics of straight insertions: a needle's line, every branch and roll along it, where each path ends, its margin.

No collision is checked here. A path along the needle is sampled so closely that what is true of its states is true
between them. Each function is followed by the compiled loop behind it: a plain one over plain arrays, for which an arm
is its lengths (d1, a2, a3, d4, d5, d6) in mm.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.inverse_kinematics import EVERY_BRANCH, N_BRANCHES, TURN, fill_branches, wrapped_angle
from puncture_twin.planning.arm.kinematics import MIN_SINGULARITY, least_term, singularity
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.numba_kernels import allocation_free, nb


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


@dataclass(frozen=True, eq=False)
class ReachRequest:
    """One direction that the arm shall reach along."""

    target_base: Floats  # shape (3,), mm: the lesion, base frame
    outward_base: Floats  # shape (3,), unit: from the target out of the body, base frame
    needle_length_mm: float
    standoff_mm: float  # tip to target before the insertion starts

    def __post_init__(self) -> None:
        for name in ("target_base", "outward_base"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


MAX_SWEEP_MM = 2.0
"""Between two collision checks no body point moves farther, so that it is never more than half of this from where it
was checked."""


class Insertion(NamedTuple):
    """A motion from standoff to target on one branch at one roll."""

    line: NeedleLine
    branch: int
    roll: float
    turn: Floats
    """Shape (6,), rad: what to add to the branch's path at roll 0, the roll and whole turns."""
    standoff: Floats  # shape (6,), rad: where the motion begins


class Surveyed(NamedTuple):
    """Kinematics of one request, of every branch and roll."""

    request: ReachRequest
    line: NeedleLine
    depths: Floats  # shape (m,), mm: the path's samples from the standoff on, rising
    distances: Floats  # shape (m,), mm: target to flange there
    rolls: Floats
    stop_at: NDArray[np.int64]
    """Shape (8,): index of the sample at which the path ends, -1 where it reaches the target."""
    starts: Floats
    """Shape (8, 6), rad: each path's first configuration at roll 0; NaN where there is none."""
    margins: Floats
    """Shape (8, r): see :func:`reach_margin`; NaN where the path ends early or leaves the joint limits."""
    turns: Floats  # shape (8, r, 6), rad: what to add to the path at roll 0, the roll and whole turns

    def insertions(self) -> Iterator[Insertion]:
        """The motions that kinematics allows, the best margin first; of equals the first branch, then roll."""
        branches, rolled = np.nonzero(~np.isnan(self.margins))
        order = np.argsort(-np.round(self.margins[branches, rolled], MARGIN_DIGITS), kind="stable")
        for branch, roll in zip(branches[order].tolist(), rolled[order].tolist(), strict=True):
            turn = self.turns[branch, roll]
            yield Insertion(self.line, branch, float(self.rolls[roll]), turn, self.starts[branch] + turn)


MARGIN_DIGITS = 9
"""Margins that agree to this many digits are equal, so that rounding does not choose between mirrored branches."""


def surveyed(
    model: UrModel, requests: Sequence[ReachRequest], lines: Sequence[NeedleLine], rolls: Floats
) -> list[Surveyed]:
    """Kinematics of each request: every branch and roll (r,), rad.

    By whole turns each motion is as far from the joint limits as possible.
    """
    bounds = (MIN_SINGULARITY, MAX_JOINT_STEP_RAD_PER_MM, FULL_MARGIN_RAD)
    stops, starts = np.empty((len(lines), N_BRANCHES), np.int64), np.empty((len(lines), N_BRANCHES, 6))
    margins = np.empty((len(lines), N_BRANCHES, len(rolls)))
    turns = np.empty((len(lines), N_BRANCHES, len(rolls), 6))
    surveys = []
    for i, (request, line) in enumerate(zip(requests, lines, strict=True)):
        depths = _depths(request.standoff_mm)
        distances = request.needle_length_mm + request.standoff_mm - depths
        path, filled = (*line, distances, depths), (stops[i], starts[i], margins[i], turns[i])
        _survey_line(model.lengths, model.joint_limits, *path, rolls, bounds, *filled)
        surveys.append(Surveyed(request, line, depths, distances, rolls, *filled))
    return surveys


def _depths(standoff_mm: float) -> Floats:
    """Samples of a path, mm from the standoff, evenly spaced: as `np.linspace` has them, four times as fast."""
    steps = math.ceil(standoff_mm / MAX_SWEEP_MM)
    depths: Floats = np.arange(steps + 1, dtype=np.float64) * (standoff_mm / steps)
    depths[-1] = standoff_mm
    return depths


@nb.njit(cache=True)
def _survey_line(lengths, limits, R, target, outward, distances, depths, rolls, bounds, stops, starts, margins, turns):  # type: ignore[no-untyped-def]  # numba infers
    """Fill, of one direction, the rows of `Surveyed`: stops (8,), starts (8, 6), margins (8, r), turns (8, r, 6).

    Args:
        bounds: Least of the singular terms; most that a joint may turn, rad/mm; distance from a limit that counts as 1,
            rad.
    """
    at_least, fastest, full = bounds
    p, here, least = np.empty(3), np.empty((8, 6)), np.ones(8)
    before, lowest, highest, middle = np.empty((8, 6)), np.empty((8, 6)), np.empty((8, 6)), np.empty((8, 6))
    stops[:], going = -1, np.int64(EVERY_BRANCH)
    for k in range(len(distances)):
        if not going:
            break
        for i in range(3):
            p[i] = target[i] + distances[k] * outward[i]
        fill_branches(lengths, R, p, here, going)
        if k == 0:
            for branch in range(8):
                for joint in range(6):
                    angle = here[branch, joint]
                    starts[branch, joint] = before[branch, joint] = angle
                    lowest[branch, joint] = highest[branch, joint] = angle
        for branch in range(8):
            if stops[branch] >= 0:
                continue
            q = here[branch]
            for joint in range(6):
                last = before[branch, joint]
                q[joint] = q[joint] if k == 0 else last + wrapped_angle(q[joint] - last)
            fast = k > 0 and _fast_joint(before[branch], q, depths[k] - depths[k - 1], fastest)
            term = math.nan if fast else least_term(lengths, q)
            if not term > at_least:
                stops[branch] = k - 1 if fast else k
                going &= ~(np.int64(1) << branch)
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


@allocation_free()
def _fast_joint(before, after, mm, fastest):  # type: ignore[no-untyped-def]  # numba infers
    """Whether a joint turns more than ``fastest``, rad/mm, between two configurations (6,) that lie so far apart."""
    fast = False
    for joint in range(6):
        fast |= abs(after[joint] - before[joint]) / mm > fastest
    return fast


@allocation_free()
def _rolled(limits, rolls, full, reached, margins, turns):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``margins`` (r,) and ``turns`` (r, 6) of one branch by what it ``reached``.

    That is the least singular term of its path at roll 0, each joint's lowest, highest and middle angle (6,), rad.
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
    """Every branch's path at flange distances (m,), mm, at roll 0, shape (8, m, 6), rad. A roll adds to q6 alone.

    Without jumps of whole turns; NaN from where a branch first does not exist.
    """
    q = np.empty((N_BRANCHES, len(distance_mm), 6))
    _every_branch(model.lengths, *line, distance_mm, q)
    return q


@nb.njit(cache=True)
def _every_branch(lengths, R, target, outward, distances, q):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``q`` (8, m, 6), see `every_branch`."""
    p, here = np.empty(3), np.empty((8, 6))
    for k in range(len(distances)):
        for i in range(3):
            p[i] = target[i] + distances[k] * outward[i]
        fill_branches(lengths, R, p, here, np.int64(EVERY_BRANCH))
        for branch in range(8):
            for joint in range(6):
                angle = here[branch, joint]
                if k > 0:
                    before = q[branch, k - 1, joint]
                    angle = before + wrapped_angle(angle - before)  # NaN stays NaN
                q[branch, k, joint] = angle


@nb.njit(cache=True)
def fill_branch_path(lengths, R, target, outward, distances, branch, turn, q):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``q`` (m, 6), rad: one branch at each distance (m,), mm, ``turn`` (6,), rad, added to every row.

    Without jumps of whole turns; NaN from where it first does not exist.
    """
    p, here = np.empty(3), np.empty((8, 6))
    for k in range(len(distances)):
        for i in range(3):
            p[i] = target[i] + distances[k] * outward[i]
        fill_branches(lengths, R, p, here, np.int64(1) << branch)
        for joint in range(6):
            angle = here[branch, joint] + turn[joint]
            q[k, joint] = angle if k == 0 else q[k - 1, joint] + wrapped_angle(angle - q[k - 1, joint])


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
