"""Which directions the arm can hold and drive through: standoff pose, straight insertion, nothing touched on the way.

Retraction is the same motion backwards, so what may be driven in may be driven out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.errors import InputError
from planning.reasons import Reason
from planning.robot.cell import Contact, StateChecker
from planning.robot.insertion import (
    MIN_SINGULARITY,
    away_from_singularities,
    first_stop,
    flange_poses,
    insertion_paths,
    reach_margin,
    why_unreachable,
)
from planning.robot.kinematics import N_BRANCHES, inverse, nearest_within_limits
from planning.robot.ur import UrModel

Array = NDArray[np.float64]

MAX_SWEEP_MM = 2.0
"""Between two collision checks no body point moves farther, so that it is never more than half of this from where it
was checked."""

SAME_LENGTH_MM = 1e-6
"""Two statements of one needle's length may differ by this much: rounding."""

SAME_UNIT = 1e-9
"""How far a direction's length may be from 1."""

ROLL_BODY = "wrist_3"
"""The only body that turns with the roll and is not round about the needle: other contacts hold for every roll."""


@dataclass(frozen=True, eq=False)
class ReachRequest:
    """One direction to reach along.

    Attributes:
        target_base: Shape (3,), mm: the lesion, base frame.
        outward_base: Shape (3,), unit: from the target out of the body, base frame.
        needle_length_mm: Flange to tip.
        standoff_mm: Tip to target before the insertion starts.

    Raises:
        InputError: If something is not finite, the direction not a unit vector, or a length not positive.
    """

    target_base: Array
    outward_base: Array
    needle_length_mm: float
    standoff_mm: float

    def __post_init__(self) -> None:
        for name in ("target_base", "outward_base"):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != (3,) or not np.isfinite(array).all():
                raise InputError(f"{name} = {array}", where="reach request", allowed="three finite numbers")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if abs(float(np.linalg.norm(self.outward_base)) - 1.0) > SAME_UNIT:
            raise InputError(f"outward_base = {self.outward_base}", where="reach request", allowed="a unit vector")
        for name in ("needle_length_mm", "standoff_mm"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise InputError(f"{name} = {getattr(self, name)}", where="reach request", allowed="finite and above 0")


@dataclass(frozen=True, eq=False)
class ReachAnswer:
    """Whether and how the arm reaches along one direction.

    Attributes:
        reachable: The verdict.
        reason: ``NONE``, ``UNREACHABLE``, ``ARM_COLLISION`` (at standoff) or ``INSERTION_BLOCKED``.
        depth_mm: How far the needle was driven from standoff when it was blocked; None for other reasons.
        detail: One sentence for people: what touched what, or what was missing; empty when reachable.
        contact: What touched what, where that was the reason.
        roll: Turn about the needle against :func:`flange_poses`' zero, rad; NaN when not reachable.
        branch: Index among the eight branches of ``inverse``; -1 when not reachable.
        insertion_q: Shape (m, 6), rad: standoff first, tip on the target last; empty when not reachable.
        insertion_depth_mm: Shape (m,), mm driven from standoff at each row.
        margin: 0..1, the least over the insertion of: each joint's distance to its limits over a quarter turn, and the
            three singularity terms. 0 when not reachable.
    """

    reachable: bool
    reason: Reason
    depth_mm: float | None
    detail: str
    contact: Contact | None
    roll: float
    branch: int
    insertion_q: Array
    insertion_depth_mm: Array
    margin: float

    def __post_init__(self) -> None:
        self.insertion_q.setflags(write=False)
        self.insertion_depth_mm.setflags(write=False)


class _Drive(NamedTuple):
    """A motion from standoff to target on one branch at one roll."""

    branch: int
    roll: float
    q: Array
    margin: float


class _Blocked(NamedTuple):
    """Where a motion ends early, and whether another roll on the same branch would meet the same."""

    depth_mm: float
    detail: str
    at_any_roll: bool = True
    at_standoff: bool = False
    contact: Contact | None = None


class _Tried(NamedTuple):
    """A motion that was checked for contacts; ``block`` is None when it is clear to the target."""

    q: Array
    depths: Array
    block: _Blocked | None


def ik_exists(
    model: UrModel,
    target_base: Array,
    outward_base: Array,
    *,
    needle_length_mm: float,
    standoff_mm: float,
    depths_mm: Sequence[float] | None = None,
    min_singularity: float = MIN_SINGULARITY,
) -> NDArray[np.bool_]:
    """Which of many directions might be reached, by kinematics alone. A False is final; a True is not a verdict yet.

    Args:
        model: The arm.
        target_base: Shape (3,) or (n, 3), mm.
        outward_base: Shape (n, 3), unit.
        needle_length_mm: Flange to tip.
        standoff_mm: Tip to target before the insertion.
        depths_mm: Insertion depths at which one and the same branch must exist; standoff and target when None.
        min_singularity: Required distance from each singularity; the roll and joint limits are not asked for.

    Returns:
        Shape (n,).
    """
    outward = np.atleast_2d(outward_base)
    holds = np.ones((len(outward), N_BRANCHES), dtype=np.bool_)
    for depth in (0.0, standoff_mm) if depths_mm is None else depths_mm:
        distance = needle_length_mm + standoff_mm - depth
        q = inverse(model, flange_poses(target_base, outward, distance))
        holds &= away_from_singularities(model, q, min_singularity)
    return np.asarray(holds.any(axis=1))


def assess_reach(
    checker: StateChecker, request: ReachRequest, *, n_rolls: int = 8, step_mm: float = MAX_SWEEP_MM
) -> ReachAnswer:
    """Find a roll and a branch on which the arm holds the standoff pose and drives straight to the target, untouched.

    All (roll, branch) pairs are ordered by margin; the first that is clear is the answer, so it is the best of them.

    Args:
        checker: Judges contacts, in the base frame.
        request: The direction.
        n_rolls: How many rolls, evenly over the turn.
        step_mm: Spacing of the insertion's samples; finer where a body would move farther than ``MAX_SWEEP_MM``.

    Raises:
        InputError: If the request's needle is not the checker's, or a number makes no sense.
    """
    if abs(request.needle_length_mm - checker.tool.needle_length_mm) > SAME_LENGTH_MM:
        allowed = f"the tool's {checker.tool.needle_length_mm}"
        raise InputError(f"needle_length_mm = {request.needle_length_mm}", where="reach request", allowed=allowed)
    if n_rolls < 1 or not step_mm > 0.0:
        raise InputError(f"n_rolls = {n_rolls}, step_mm = {step_mm}", where="reach", allowed="both above 0")
    model = checker.model
    depths = _depths(request, step_mm)
    paths = _paths(model, request, depths)
    holds = away_from_singularities(model, paths[:, 0])
    if not holds.any():
        distance = request.needle_length_mm + request.standoff_mm
        why = why_unreachable(model, flange_poses(request.target_base, request.outward_base, distance)[0])
        return _refusal(Reason.UNREACHABLE, None, why)
    stops = [first_stop(model, path, depths) for path in paths]
    drivable = [branch for branch, stop in enumerate(stops) if stop is None]
    rolls = 2.0 * math.pi * np.arange(n_rolls) / n_rolls
    drives = [drive for i in drivable for roll in rolls if (drive := _drive(model, i, float(roll), paths[i]))]
    if drives:
        return _first_clear(checker, request, depths, sorted(drives, key=lambda drive: -drive.margin))
    if drivable:
        return _refusal(Reason.UNREACHABLE, None, "every roll and branch leaves the joint limits")
    begun = (stop for stop, holds_standoff in zip(stops, holds, strict=True) if stop and holds_standoff)
    deepest = max(begun, key=lambda stop: stop.depth_mm)
    return _refusal(Reason.INSERTION_BLOCKED, deepest.depth_mm, deepest.detail)


def _depths(request: ReachRequest, step_mm: float) -> Array:
    return np.linspace(0.0, request.standoff_mm, math.ceil(request.standoff_mm / step_mm) + 1)


def _paths(model: UrModel, request: ReachRequest, depths_mm: Array) -> Array:
    """Every branch's way at roll 0, shape (8, m, 6)."""
    distance = request.needle_length_mm + request.standoff_mm - depths_mm
    return insertion_paths(model, request.target_base, request.outward_base, distance)


def _drive(model: UrModel, branch: int, roll: float, path: Array) -> _Drive | None:
    """The branch's motion at one roll, turned as far from the joint limits as whole turns allow; None if outside."""
    q = path.copy()
    q[:, 5] += roll
    middle = q[len(q) // 2]
    q += nearest_within_limits(model, middle, model.joint_limits.mean(axis=1)) - middle
    if not model.within_limits(q).all():
        return None
    return _Drive(branch, roll, q, reach_margin(model, q))


def _first_clear(checker: StateChecker, request: ReachRequest, depths: Array, drives: Sequence[_Drive]) -> ReachAnswer:
    """The first of several motions that touches nothing; else a refusal with the one that came farthest."""
    blocks: list[_Blocked] = []
    hopeless: set[int] = set()
    for drive in drives:
        if drive.branch in hopeless:
            continue
        tried = _try(checker, request, drive, depths)
        if tried.block is None:
            return _success(checker.model, drive, tried)
        blocks.append(tried.block)
        if tried.block.at_any_roll:
            hopeless.add(drive.branch)
    deepest = max(blocks, key=lambda block: block.depth_mm)  # the first of equals: the best margin
    if deepest.at_standoff:
        return _refusal(Reason.ARM_COLLISION, None, deepest.detail, deepest.contact)
    return _refusal(Reason.INSERTION_BLOCKED, deepest.depth_mm, deepest.detail, deepest.contact)


def _try(checker: StateChecker, request: ReachRequest, drive: _Drive, depths: Array) -> _Tried:
    """Check one motion for contacts, standoff first."""
    contact = checker.contact(drive.q[0], needle_may_touch_patient=False)
    if contact is not None:
        detail = f"{contact.body} touches {contact.other} at standoff"
        block = _Blocked(0.0, detail, ROLL_BODY not in contact, at_standoff=True, contact=contact)
        return _Tried(drive.q, depths, block)
    q, depths = _refined(checker, request, drive, depths)
    stop = first_stop(checker.model, q, depths)
    if stop is not None:
        return _Tried(q, depths, _Blocked(stop.depth_mm, stop.detail))
    if not checker.model.within_limits(q).all():
        return _Tried(q, depths, _Blocked(0.0, "a joint leaves its limits on the way", at_any_roll=False))
    for row, depth in zip(q, depths, strict=True):
        contact = checker.contact(row, needle_may_touch_patient=True)
        if contact is not None:
            detail = f"{contact.body} touches {contact.other} {depth:.1f} mm after the standoff"
            return _Tried(q, depths, _Blocked(float(depth), detail, ROLL_BODY not in contact, contact=contact))
    return _Tried(q, depths, None)


def _refined(checker: StateChecker, request: ReachRequest, drive: _Drive, depths: Array) -> tuple[Array, Array]:
    """The motion sampled so that no body moves more than ``MAX_SWEEP_MM`` from sample to sample, and its depths."""
    q = drive.q
    while (worst := checker.sweep_mm(q).max()) > MAX_SWEEP_MM:
        depths = np.linspace(0.0, request.standoff_mm, math.ceil((len(depths) - 1) * worst / MAX_SWEEP_MM) + 1)
        path = _paths(checker.model, request, depths)[drive.branch]
        path[:, 5] += drive.roll
        q = path + np.round((drive.q[0] - path[0]) / (2.0 * math.pi)) * 2.0 * math.pi
        if np.isnan(q).any():
            break  # the caller finds where
    return q, depths


def _success(model: UrModel, drive: _Drive, tried: _Tried) -> ReachAnswer:
    margin = reach_margin(model, tried.q)
    return ReachAnswer(True, Reason.NONE, None, "", None, drive.roll, drive.branch, tried.q, tried.depths, margin)


def _refusal(reason: Reason, depth_mm: float | None, detail: str, contact: Contact | None = None) -> ReachAnswer:
    return ReachAnswer(False, reason, depth_mm, detail, contact, math.nan, -1, np.empty((0, 6)), np.empty(0), 0.0)
