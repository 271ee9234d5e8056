"""Sweeps: the needle's axis through one fixed point while its direction changes, as far as every direction is safe.

A direction is passed only if the search calls it safe: organs, skin and the arm's straight insertion; and if the arm
can go on from the one before. The needle stays outside the body; arm, holder and needle keep their distance all along.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.insertion import ReachRequest
from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import away_from_singularities, flange_pose, slowed
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError, refuse
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.case.entry import outward
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.workcell import home_configuration
from puncture_twin.planning.geometry.rigid import apply, exp_rotation
from puncture_twin.planning.motion.approach import plan_approach
from puncture_twin.planning.motion.follow import follow_smoothly
from puncture_twin.planning.motion.path_check import FINER, RESOLUTION_RAD, dense_states
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.reach.reach import approach_goals
from puncture_twin.planning.reach.standoff import standoffs
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import reason_text


@dataclass(frozen=True, eq=False)
class SweepPlan:
    """A motion about the virtual TCP (Chen 2019): the point on the needle's axis, a standoff before its tip."""

    model: UrModel
    needle_length_mm: float
    standoff_mm: float
    point_base: Floats  # shape (3,), mm: where the virtual TCP stays, the target
    angles: Floats  # shape (k, 2), rad: theta and beta of every direction that is passed, a degree apart or less
    wanted: tuple[float, float]  # theta and beta, rad, where it should have ended
    approach: Trajectory
    sweep: Trajectory
    stopped: str  # where and why it ends before; empty where it does not

    def off_point_mm(self, T_base_flange: Floats) -> Floats:
        """Distance of the virtual TCP from its point at flange poses (m, 4, 4), mm, shape (m,)."""
        reach = self.needle_length_mm + self.standoff_mm
        virtual = T_base_flange[:, :3, 3] + reach * T_base_flange[:, :3, 2]
        return np.asarray(np.linalg.norm(virtual - self.point_base, axis=1))


STEP = np.radians(1.0)
"""Greatest angle between two checked directions: half of the search's usual grid."""
MOST_JOINT_STEP = 0.2
"""A joint that turns more from one direction to the next jumps, rad."""
SWEEP_SPEED_MM_S = 30.0
"""Speed of the needle's tip, in the air."""


def plan_sweep(
    context: CaseContext, start: tuple[float, float], end: tuple[float, float], *, seed: int, progress: Count
) -> SweepPlan:
    """Plan from one direction to another, on the straight line in theta and beta, rad, as far as it is allowed.

    Beta takes the shorter arc.

    Raises:
        InputError: The case does not say where the robot stands, or both directions are one.
        NoAnswerError: The first directions are not allowed, or no approach to them was found.
    """
    reach = context.require_arm()
    change = np.array([end[0] - start[0], (end[1] - start[1] + np.pi) % (2 * np.pi) - np.pi])
    count = int(np.ceil(np.abs(change).max() / STEP))
    if count == 0:
        refuse("the sweep ends where it starts", "--to", "another direction", "no_motion")
    route = _allowed(context, start + np.linspace(0.0, 1.0, count + 1)[:, None] * change, progress)
    point = apply(reach.T_base_ct, context.case.target_ct)
    T_base_ct, frame = reach.T_base_ct, context.case.T_ct_entry[:3, :3]
    directions = outward(route.angles[:, 0], route.angles[:, 1]) @ (T_base_ct[:3, :3] @ frame).T
    q, stopped = _farthest(context, point, directions, route)
    if len(q) < 2:
        raise NoAnswerError(f"no sweep: {stopped}", code="sweep_stops")
    speeds, checker = context.case.robot.speeds, reach.checker
    approach = plan_approach(checker, home_configuration(context.case), q[0], seed=seed, speeds=speeds)
    rotated = np.arccos(np.clip(np.vecdot(directions[1 : len(q)], directions[: len(q) - 1]), -1.0, 1.0))
    arc = route.standoff_mm * np.concatenate([[0.0], np.cumsum(rotated)])
    sweep = follow_smoothly(slowed(checker.model, speeds), q, arc, max_tip_speed_mm_s=SWEEP_SPEED_MM_S)
    states = dense_states(checker, sweep.q, RESOLUTION_RAD / FINER)
    contact = checker.first_contact(states, needle_may_touch_patient=False)
    if contact is not None:
        what = f"no sweep: between its directions {contact.contact.body} touches {contact.contact.other}"
        raise NoAnswerError(what, code="motion_touches")
    lengths, passed = (context.case.needle.length_mm, route.standoff_mm), route.angles[: len(q)]
    return SweepPlan(checker.model, *lengths, point, passed, end, approach.trajectory, sweep, stopped)


def _allowed(context: CaseContext, angles: Floats, progress: Count) -> _SweepPath:
    """Directions up to the first that the search, with the arm, does not call safe."""
    standoff, passed, stopped = 0.0, 0, ""
    for row, (theta, beta) in enumerate(angles.tolist()):
        candidates = context.check(theta, beta % (2 * np.pi))
        if not candidates.safe[0]:
            stopped = f"{_place(angles[row])} is rejected: {reason_text(candidates, 0)}"
            break
        needed = standoffs(context.case.needle, candidates.path.length[0], candidates.path.skin_angle[0])
        standoff, passed = max(standoff, float(needed)), row + 1
        progress(passed, len(angles))
    return _SweepPath(angles[:passed], standoff, stopped)


def _place(angles: Floats) -> str:
    theta, beta = np.degrees(angles)
    return f"theta {theta:.1f} deg, beta {beta % 360:.1f} deg"


class _SweepPath(NamedTuple):
    angles: Floats  # shape (k, 2), rad
    standoff_mm: float
    stopped: str


def _farthest(context: CaseContext, point: Floats, directions: Floats, route: _SweepPath) -> tuple[Floats, str]:
    """The path that goes farthest among all rolls and branches at the first direction, (k, 6), and why it ends."""
    assert context.reach is not None
    if not len(directions):
        return np.empty((0, 6)), route.stopped
    checker, length = context.reach.checker, context.case.needle.length_mm
    request = ReachRequest(point, directions[0], length, route.standoff_mm)
    best, why = np.empty((0, 6)), f"the arm cannot start at {_place(route.angles[0])}"
    for goal in approach_goals(checker, request, home_configuration(context.case)):
        q, stop = _followed(checker, goal.insertion_q[0], point, directions, length + route.standoff_mm)
        if len(q) > len(best):
            best, why = q, f"at {_place(route.angles[len(q)])} {stop}" if stop else route.stopped
        if len(best) == len(directions):
            break
    return best, why


def _followed(
    checker: CellChecker, q_start: Floats, point: Floats, directions: Floats, reach_mm: float
) -> tuple[Floats, str]:
    """The arm's path through directions (k, 3) with its flange so far from the point; where it ends, and why."""
    rows = [q_start]
    R = flange_pose(checker.model, q_start)[:3, :3]
    for direction in directions[1:]:
        axis = np.cross(R[:, 2], -direction)
        sine = float(np.linalg.norm(axis))
        if sine > 0.0:  # rotated until its z axis is the new one, and no farther
            R = exp_rotation(axis / sine * float(np.arctan2(sine, R[:, 2] @ -direction))) @ R
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, point + reach_mm * direction
        every = nearest_within_limits(checker.model, inverse(checker.model, T)[0], rows[-1])
        away = np.where(np.isnan(every).any(axis=1), np.inf, np.abs(every - rows[-1]).max(axis=1))
        q = every[int(np.argmin(away))]
        why = _why_not(checker, rows[-1], q, float(away.min()))
        if why:
            return np.array(rows), why
        rows.append(q)
    return np.array(rows), ""


def _why_not(checker: CellChecker, before: Floats, q: Floats, step: float) -> str:
    if not np.isfinite(step):
        return "the arm cannot reach further, or a joint would exceed its limits"
    if step > MOST_JOINT_STEP:
        return "a joint would jump"
    if not away_from_singularities(checker.model, q):
        return "the arm would be too near a singularity"
    states = dense_states(checker, np.stack([before, q]), RESOLUTION_RAD / FINER)
    contact = checker.first_contact(states, needle_may_touch_patient=False)
    return "" if contact is None else f"{contact.contact.body} touches {contact.contact.other}"
