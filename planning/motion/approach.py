"""The approach from home to a standoff pose: RRT-Connect to several goals, shortened, rounded, timed, checked by FCL.

A fast checker proves whole segments (:class:`SegmentChecker`). With FCL alone a segment is checked at
samples, which can miss something thin; the check of the finished motion is closer, and what it refuses is planned anew.
"""

import math
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.kinematics import DEFAULT_SPEEDS, SpeedLimits, TipLimit, slowed
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.collision.bodies import Contact
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker, halving_order
from puncture_twin.planning.motion import shortest
from puncture_twin.planning.motion.follow import follow, rounded
from puncture_twin.planning.motion.path_check import FINER, RESOLUTION_RAD, dense_states, first_contact
from puncture_twin.planning.motion.rrt_connect import CLEARANCE_MM, Connected, SegmentContact
from puncture_twin.planning.motion.trajectory import Trajectory

ATTEMPTS = 6
"""Paths that the finer check may refuse; for FCL alone each next one is planned at half the resolution."""
CUT_FRACTION = 0.5
"""A corner is rounded from the middle of its shorter segment on: the farther, the faster."""
HALVINGS = 5
"""Halvings of a rounding that is not free; then the arm stops at the corner."""
CURVE_PIECES = 8
"""Straight pieces as which a rounding is checked when it is chosen; the finished trajectory is checked at samples."""


@dataclass(frozen=True, eq=False)
class Approach:
    """A collision-free motion from home to a standoff pose, with the needle outside the patient."""

    waypoints: Floats  # shape (k, 6), rad, k >= 2: straight joint segments from home to the goal
    cuts: Floats
    """Shape (k - 2,), rad: how far from each waypoint between the ends its rounding begins; 0 stops there."""
    trajectory: Trajectory
    """The motion: rounded at the waypoints, within the limits of speed, acceleration and jerk."""
    goal_index: int
    checked_q: Floats
    """Shape (m, 6), rad: the states that FCL found free, in order, as of :func:`dense_states`."""
    seed: int
    attempts: int

    def __post_init__(self) -> None:
        for array in (self.waypoints, self.cuts, self.checked_q):
            array.setflags(write=False)


def plan_approach(
    checker: CellChecker,
    q_home: Floats,
    q_goals: Floats,
    *,
    seed: int,
    max_samples: int = shortest.MAX_SAMPLES,
    speeds: SpeedLimits = DEFAULT_SPEEDS,
) -> Approach:
    """Plan the shortest path that is found from home to any of the goals, and its motion in time.

    Args:
        q_home: Shape (6,), rad, within the joint limits.
        q_goals: Shape (6,) or (g, 6), rad, within the joint limits.

    Raises:
        NoAnswerError: If home or every goal is in collision, or no path was found; it names the contacts that blocked.
    """
    home, goals = np.asarray(q_home, dtype=np.float64), np.atleast_2d(q_goals)
    touched = checker.contact(home, needle_may_touch_patient=False)  # no segment's check looks at where it begins
    if touched is not None:
        raise NoAnswerError(f"home is in collision: {touched.body} touches {touched.other}", code="home_in_collision")
    limits, tip = slowed(checker.model, speeds), TipLimit(checker.tool.needle_length_mm, speeds.tip_speed_mm_s)
    refused, ends = "", _Ends(checker, home, goals)
    for attempt in range(ATTEMPTS):
        contact_of = _segment_check(checker, RESOLUTION_RAD / 2**attempt)
        path: shortest.Path | Connected | None = shortest.direct_path(contact_of, home, goals)
        if path is None:
            path = _searched(ends, contact_of, seed + shortest.RUNS * attempt, max_samples)
        if isinstance(path, Connected):  # two trees that were not joined
            raise NoAnswerError(_why_none(path, ends, seed) + refused, code="no_approach")
        cuts = _cuts(contact_of, path.waypoints)
        for rounding in (cuts, np.zeros_like(cuts)) if cuts.any() else (cuts,):  # rounded, else with stops at corners
            trajectory = follow(limits, path.waypoints, rounding, tip=tip)
            checked = dense_states(checker, trajectory.q, RESOLUTION_RAD / FINER)
            contact = first_contact(checker, checked)  # FCL's, along the finished motion
            if contact is None:
                return Approach(path.waypoints, rounding, trajectory, path.goal_index, checked, seed, attempt + 1)
        assert contact is not None
        refused = f"; before that, a finer check found {contact.body} touching {contact.other}"
    raise NoAnswerError(f"approach unknown: {ATTEMPTS} paths were refused (seed {seed}){refused}", code="no_approach")


class _Ends:
    """Home and goals of an approach; which goals are free or cut off from home is computed when first needed."""

    def __init__(self, checker: CellChecker, home: Floats, goals: Floats) -> None:
        self.checker, self.home, self.goals = checker, home, goals

    @cached_property
    def open_goals(self) -> NDArray[np.int64]:
        """Rows of the goals that are free of contact; an error where none is."""
        contacts = self.checker.contacts(self.goals, needle_may_touch_patient=False)
        if all(contacts):
            named = sorted({f"{contact.body} touches {contact.other}" for contact in contacts if contact})
            raise NoAnswerError(f"every goal is in collision: {', '.join(named)}", code="goals_in_collision")
        return np.flatnonzero([contact is None for contact in contacts])

    @cached_property
    def cut(self) -> shortest.Cut:
        """The proof of which free goals are cut off from home."""
        points, goals = self.checker.points_of(shortest.UPPER_ARM), self.goals[self.open_goals]
        return shortest.Cut(self.checker.model, self.checker.boxes, points, self.home, goals)


def _searched(ends: _Ends, contact_of: SegmentContact, seed: int, max_samples: int) -> shortest.Path | Connected:
    """The shortest path that a search to the free goals finds; its ``goal_index`` is a row of all goals."""
    checker, limits = ends.checker, ends.checker.model.joint_limits
    clear_of = checker.segment_checker(CLEARANCE_MM) if isinstance(checker, FastChecker) else None
    task = shortest.Task(limits, contact_of, ends.home, ends.goals[ends.open_goals], ends.cut, clear_of)
    path = shortest.shortest_path(task, seed=seed, max_samples=max_samples)
    return path if isinstance(path, Connected) else path._replace(goal_index=int(ends.open_goals[path.goal_index]))


def _segment_check(checker: CellChecker, resolution_rad: float) -> SegmentContact:
    if isinstance(checker, FastChecker):
        return checker.segment_checker()

    def sampled(start: Floats, end: Floats) -> Contact | None:
        fractions = halving_order(max(1, math.ceil(float(np.linalg.norm(end - start)) / resolution_rad)))
        states = end + fractions[:, None] * (start - end)
        return first_contact(checker, states)

    return sampled


def _cuts(contact_of: SegmentContact, waypoints: Floats) -> Floats:
    """Distance from each inner waypoint at which its rounding may begin, shape (k - 2,), rad; 0 where none is free."""
    steps, cuts = np.diff(waypoints, axis=0), np.zeros(len(waypoints) - 2)
    lengths = np.linalg.norm(steps, axis=1)
    if not lengths.all():
        return cuts
    directions = steps / lengths[:, None]
    fraction = np.linspace(0.0, 1.0, CURVE_PIECES + 1)
    for at in range(len(cuts)):
        cut = CUT_FRACTION * float(lengths[at : at + 2].min())
        for _ in range(HALVINGS):
            curve = rounded(waypoints[at + 1], directions[at], directions[at + 1], cut, fraction)
            if all(contact_of(start, end) is None for start, end in pairwise(curve)):
                cuts[at] = cut
                break
            cut /= 2.0
    return cuts


def _why_none(run: Connected, ends: _Ends, seed: int) -> str:
    cut, n_goals, n_free = ends.cut, len(ends.goals), len(ends.open_goals)
    busy = "" if n_free == n_goals else f"; {n_goals - n_free} of {n_goals} goals are in collision themselves"
    n_off = int(cut.off.sum())
    if n_off == n_free:
        return f"approach proven impossible: {cut.text}{busy}"
    where = "the goals are" if run.goal_states <= run.home_states else "home is"
    trees = f"{run.home_states} states joined home, {run.goal_states} the goals"
    total = sum(run.blocked.values())
    most = [f"{c.body} touches {c.other} ({n} of {total})" for c, n in Counter(run.blocked).most_common(2)]
    proven = f"; {n_off} of {n_free} goals are proven to be cut off" if n_off else ""
    return (
        f"approach unknown after {run.samples} samples (seed {seed}): {where} in a part of the space that the "
        f"search did not reach: {trees}; most frequent contacts: {', '.join(most) or 'nothing'}{proven}{busy}"
    )
