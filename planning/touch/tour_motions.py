"""Motions of a marker tour: from home through all standoffs at least cost and back, each touch, and the puncture after.

A touch is a straight line along the needle onto the marker. The needle must touch nothing but the marker: with its
foremost `TIP_MM` taken off, it keeps its padding from the patient all the way, so that no shaft passes through them.
Arm and holder keep their distance as everywhere. `plan_puncture` goes to where the touches' registration puts the
target, in the posture that they were chosen for.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.anatomy.skin import skin_paths
from puncture_twin.planning.arm.insertion import MAX_JOINT_STEP_RAD_PER_MM
from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import flange_pose, slowed
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.case.entry import angles
from puncture_twin.planning.collision.bodies import NEEDLE_IN_PATIENT
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.workcell import case_checker, home_configuration
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.motion.approach import plan_approach
from puncture_twin.planning.motion.follow import follow_smoothly
from puncture_twin.planning.motion.path_check import dense_states
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan, motion_contact
from puncture_twin.planning.plan.plan_check import roll_of
from puncture_twin.planning.reach.standoff import standoffs
from puncture_twin.planning.registration.registration import Registration
from puncture_twin.planning.search.context import CaseContext


@dataclass(frozen=True, eq=False)
class Touch:
    """The touch of one marker."""

    name: str
    point_base: Floats  # shape (3,), where it is believed to be
    q_touch: Floats  # shape (6,), rad, the tip on it
    come: Trajectory


@dataclass(frozen=True, eq=False)
class TouchTour:
    """Touches in order, each with the motion to it, and the motion home."""

    model: UrModel
    tip_mm: float
    touches: tuple[Touch, ...]
    leave: Trajectory


@dataclass(frozen=True, eq=False)
class TouchPlan(TouchTour):
    """A planned tour of the markers for a puncture."""

    left_out: Mapping[str, str]
    expected_mm: float  # of the tip at the target when the registration comes from these touches (rms), mm
    worst_mm: float  # ``expected_mm`` with the worst of the poses that could be taken, mm


RESOLUTION = 1e-9
"""Rounding of costs, in their unit: sums of whole multiples are exact."""


class NoMotionError(NoAnswerError):
    """Raised where no motion leads to the standoff of one of the touches."""

    def __init__(self, place: int, why: str, code: str) -> None:
        self.place = place
        super().__init__(why, code=code)


class Stops(NamedTuple):
    """Stops of a tour: names, points (n, 3), mm, base frame, and joints (n, 6), rad."""

    names: tuple[str, ...]
    points_base: Floats
    q_touch: Floats


def tour_through(context: CaseContext, stops: Stops, *, seed: int, progress: Count) -> TouchTour:
    """Plan the motions of a tour through stops.

    Raises:
        NoMotionError: None to a stop.
        NoAnswerError: None home.
    """
    assert context.reach is not None
    case, checker, home = context.case, context.reach.checker, home_configuration(context.case)
    tip_mm = case.needle.length_mm
    lines = [line_to(checker.model, tip_mm, q, STANDOFF_MM, 0.0) for q in stops.q_touch]
    places = np.array([*(line[0] for line in lines if line is not None), home])
    order = shortest_tour((np.abs(places[:, None] - places) / checker.model.max_speeds).max(axis=2))
    legs = []
    for start, end in pairwise([len(places) - 1, *order, len(places) - 1]):
        try:
            motion = plan_approach(checker, places[start], places[end], seed=seed, speeds=case.robot.speeds)
        except NoAnswerError as error:
            if end in order:
                raise NoMotionError(end, str(error), error.code) from error
            raise
        legs.append(motion.trajectory)
        progress(len(legs), len(places))
    touched = zip(order, legs, strict=False)
    touches = (Touch(stops.names[at], stops.points_base[at], stops.q_touch[at], leg) for at, leg in touched)
    return TouchTour(case.robot.model, tip_mm, tuple(touches), legs[-1])


def shortest_tour(cost: ArrayLike) -> tuple[int, ...]:
    """The order of n places of least total cost, by dynamic programming over subsets; of equal ones the first in order.

    The cost (n + 1, n + 1), symmetric or not, is from row to column, the last of each home. Where it is symmetric, a
    tour and its reverse cost the same: sums of rounded floats would choose between them.

    Source: Held and Karp 1962, "A dynamic programming approach to sequencing problems". 2^n n^2 steps: n to a dozen.
    """
    of = np.rint(np.asarray(cost, dtype=np.float64) / RESOLUTION).astype(np.int64).tolist()
    n = len(of) - 1
    best: dict[tuple[int, int], tuple[int, tuple[int, ...]]] = {(1 << k, k): (of[n][k], (k,)) for k in range(n)}
    for size in range(2, n + 1):
        for places in combinations(range(n), size):
            whole = sum(1 << k for k in places)
            for last in places:
                before = (best[whole & ~(1 << last), k] for k in places if k != last)
                best[whole, last] = min((so_far + of[order[-1]][last], (*order, last)) for so_far, order in before)
    whole = (1 << n) - 1
    return min((best[whole, last][0] + of[last][n], best[whole, last][1]) for last in range(n))[1]


STANDOFF_MM = 20.0
"""Where the straight line begins, away from the marker: the needle is clear of the patient there."""
SLOW_MM = 5.0
"""From here on the tip moves at touching speed."""
PAST_MM = 5.0
"""So far beyond its believed place a marker is searched for by contact; then the touch is given up."""
TIP_MM = 8.0
"""Length of the needle that may be nearer than its padding to the patient: the marker sits on their skin."""
STEP_MM = 0.5
"""Between two configurations of the line."""
RESOLUTION_RAD = 0.005
"""Largest joint distance between two checked states of the line."""


@dataclass(frozen=True, eq=False)
class ApproachCheckers:
    """Two views of one workcell, ``blunted`` with a needle that is `TIP_MM` shorter."""

    whole: CellChecker
    blunted: CellChecker


def line_to(model: UrModel, tip_mm: float, q_touch: Floats, from_mm: float, to_mm: float) -> Floats | None:
    """Joints along the needle's line through a touch (6,), rad; shape (m, 6), rad; None where the arm cannot follow it.

    The tip moves between distances before the marker, mm, negative beyond it.
    """
    count = max(2, int(np.ceil(abs(from_mm - to_mm) / STEP_MM)) + 1)
    distances = np.linspace(from_mm, to_mm, count)
    poses = np.tile(flange_pose(model, q_touch), (count, 1, 1))
    poses[:, :3, 3] -= distances[:, None] * poses[:, :3, 2]
    every = nearest_within_limits(model, inverse(model, poses), q_touch)
    away = np.abs(every - q_touch).max(axis=2)
    q = every[np.arange(count), np.argmin(np.where(np.isnan(away), np.inf, away), axis=1)]
    step = MAX_JOINT_STEP_RAD_PER_MM * abs(from_mm - to_mm) / (count - 1)
    if np.isnan(q).any() or np.abs(np.diff(q, axis=0)).max() > step:
        return None
    nearest = int(np.argmin(np.abs(distances)))  # to the marker: there it is the touch's own branch
    allowed = MAX_JOINT_STEP_RAD_PER_MM * (abs(float(distances[nearest])) + STEP_MM)
    return q if np.abs(q[nearest] - q_touch).max() <= allowed else None


def why_not(checkers: ApproachCheckers, tip_mm: float, q_touch: Floats) -> str:
    """Reason that the arm cannot approach a touch (6,), rad, straight, in words; empty where it can."""
    whole = checkers.whole
    if not whole.model.within_limits(q_touch[None])[0]:
        return "a joint would exceed its limits"
    line = line_to(whole.model, tip_mm, q_touch, STANDOFF_MM, -PAST_MM)
    if line is None:
        return "the arm cannot follow the straight line to it"
    standoff = whole.contact(line[0], needle_may_touch_patient=False)
    if standoff is not None:
        return f"at the standoff {standoff.body} touches {standoff.other}"
    hit = whole.first_contact(dense_states(whole, line, RESOLUTION_RAD), needle_may_touch_patient=True)
    if hit is not None:
        return f"{hit.contact.body} touches {hit.contact.other}"
    before = line_to(whole.model, tip_mm, q_touch, STANDOFF_MM, 0.0)
    assert before is not None  # a part of the whole line
    states = dense_states(checkers.blunted, before, RESOLUTION_RAD)
    shaft = checkers.blunted.first_contact(states, needle_may_touch_patient=False)
    if shaft is None:
        return ""
    if shaft.contact == NEEDLE_IN_PATIENT:
        return "the needle's shaft would go through the patient"
    return f"{shaft.contact.body} touches {shaft.contact.other}"


def registered_joints(
    model: UrModel, tip_mm: float, q_insertion: Floats, target_ct: Floats, T_base_ct: tuple[Floats, Floats]
) -> Floats:
    """Joints (6,), rad, that put the needle as planned in the CT, by a new registration, in the plan's branch.

    The plan's are ``q_insertion`` (6,), rad, the tip on the target (3,), mm; T_base_ct are its belief and the new one,
    (4, 4) each, mm.

    Raises:
        NoAnswerError: The arm does not reach there.
    """
    believed, registered = T_base_ct
    T = flange_pose(model, q_insertion)
    T[:3, :3] = registered[:3, :3] @ believed[:3, :3].T @ T[:3, :3]
    T[:3, 3] = apply(registered, target_ct) - tip_mm * T[:3, 2]
    every = nearest_within_limits(model, inverse(model, T)[0], q_insertion)
    away = np.abs(every - q_insertion).max(axis=1)
    if np.isnan(away).all():
        raise NoAnswerError("the arm does not reach the target where the touches locate it", code="out_of_reach")
    return np.asarray(every[int(np.nanargmin(away))])


def plan_puncture(context: CaseContext, outward_ct: Floats, q_insertion: Floats, registration: Registration) -> Plan:
    """Plan the puncture along a direction by a new registration, free of contact where that puts the patient.

    The context believes of patient and arm what the touches were planned by, for ``q_insertion`` (6,), rad, the tip on
    the target; ``outward_ct`` (3,), unit, is from there along the needle.

    Raises:
        NoAnswerError: The arm does not reach there, or not without contact.
    """
    case, T = context.case, registration.T_base_ct
    assert context.placement is not None
    checker, speeds = case_checker(case, context.anatomy, T), case.robot.speeds
    model, tip_mm, believed = checker.model, case.needle.length_mm, context.placement.T_base_ct
    q = registered_joints(model, tip_mm, q_insertion, case.target_ct, (believed, T))
    paths = skin_paths(context.anatomy.skin, case.target_ct, outward_ct[None], tip_mm)
    standoff = float(standoffs(case.needle, paths.path_length[0], paths.skin_angle[0]))
    line = line_to(model, tip_mm, q, standoff, 0.0)
    if line is None:
        what = "the arm cannot follow the needle's line to the target where the touches locate it"
        raise NoAnswerError(what, code="out_of_reach")
    approach = plan_approach(checker, home_configuration(case), line[0], seed=case.rehearsal.seed, speeds=speeds)
    theta, beta = angles(case.T_ct_entry[:3, :3].T @ outward_ct)
    depths = np.linspace(0.0, standoff, len(line))
    plan = Plan(
        case_name=case.name,
        inputs=case.inputs,
        seed=case.rehearsal.seed,
        model=case.robot.model,
        T_base_ct=T,
        expected_target_error_mm=float(registration.expected_tre_mm(case.target_ct[None])[0]),
        theta=float(theta),
        beta=float(beta),
        entry_ct=paths.entry_ct[0],
        target_ct=case.target_ct,
        outward_ct=outward_ct,
        roll=0.0,
        standoff_mm=standoff,
        needle_length_mm=tip_mm,
        approach=approach.trajectory,
        insertion=follow_smoothly(slowed(model, speeds), line, depths, max_tip_speed_mm_s=speeds.insertion_speed_mm_s),
        clearance_mm={},
        warnings=context.anatomy.warnings,
        speeds=speeds,
    )
    touched = motion_contact(plan, checker)
    if touched is not None:
        raise NoAnswerError(touched, code="motion_touches")
    return replace(plan, roll=roll_of(plan))
