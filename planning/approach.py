"""From home to the standoff pose: RRT-Connect, shortened, and checked again by FCL before anyone believes it.

Nothing here depends on the clock: the planner stops after a number of iterations, so the same seed gives the same
path. OMPL keeps one random generator for the whole process and reseeds it here; two plans must not run in two threads.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from ompl import base as ob
from ompl import geometric as og
from ompl import util as ou

from planning.errors import InputError, NoAnswerError
from planning.robot.cell import DISTANCE_PAIRS, Contact, Distances, Nearest, StateChecker

Array = NDArray[np.float64]

RESOLUTION_RAD = 0.05
"""Joint distance between the states that the planner itself checks: up to 50 mm at a metre, so never the last word."""

FINER = 10
"""The check afterwards is this many times finer."""

MAX_SWEEP_MM = 2.0
"""And so fine that no body point moves farther between two checked states."""

RANGE_RAD = 0.5
"""Longest branch of the planner's trees."""

MAX_ITERATIONS = 2000
"""Of the planner: what is possible takes it tens of them; all of them take about 10 s."""

ATTEMPTS = 6
"""Plans that the finer check may refuse; each next one plans at half the resolution."""

END_TOLERANCE_RAD = 1e-9
"""How far the planner's ends may be from home and goal: rounding."""

CLEARANCE_STEP_MM = 1.0
"""The least clearance is found to this: states that cannot improve on it by more are passed over."""

SEEDS = 2**31 - 1
"""OMPL takes positive seeds; 0 would mean its own choice."""


@dataclass(frozen=True, eq=False)
class Approach:
    """A collision-free joint path from home to a standoff pose, with the needle outside the patient.

    Attributes:
        waypoints: Shape (k, 6), rad, k >= 2: straight joint segments from home to the goal.
        goal_index: Which of the goals it ends at.
        checked_q: Shape (m, 6), rad: the states that FCL found free, in order; no body moves more than
            ``MAX_SWEEP_MM`` between two of them.
        clearance: The least distances met on the way; the true least over the checked states are at most
            ``CLEARANCE_STEP_MM`` less.
        seed: The seed that gave it.
        attempts: How many plans it took.
    """

    waypoints: Array
    goal_index: int
    checked_q: Array
    clearance: Distances
    seed: int
    attempts: int

    def __post_init__(self) -> None:
        self.waypoints.setflags(write=False)
        self.checked_q.setflags(write=False)

    @property
    def length_rad(self) -> float:
        """Joint-space length, rad."""
        return path_length(self.waypoints)


def path_length(waypoints: Array) -> float:
    """Joint-space length of straight segments through (k, 6), rad."""
    return float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())


def plan_approach(
    checker: StateChecker, q_home: Array, q_goals: Array, *, seed: int, max_iterations: int = MAX_ITERATIONS
) -> Approach:
    """Plan from home to any of several goals.

    Args:
        checker: Judges contacts.
        q_home: Shape (6,), rad, within the joint limits.
        q_goals: Shape (6,) or (g, 6), rad, within the joint limits.
        seed: Of OMPL's generator. Same seed, same path.
        max_iterations: Of the planner, in each plan. Only a path that the finer check refuses is planned again.

    Raises:
        InputError: If home or a goal is not six finite angles within the limits.
        NoAnswerError: If home or every goal is in collision, or no path was found.
    """
    home = _within_limits(checker, q_home, "home")[0]
    goals = _within_limits(checker, q_goals, "goal")
    _refuse_contact(checker, home, goals)
    refused = ""
    for attempt in range(ATTEMPTS):
        resolution = RESOLUTION_RAD / 2**attempt
        path = _plan(checker, home, goals, seed + attempt, max_iterations, resolution)
        if path is None:
            refused = f"no path within {max_iterations} iterations" + (refused and f"; before that, {refused}")
            break
        waypoints, goal_index = _with_exact_ends(path, home, goals)
        checked = dense_states(checker, waypoints, resolution / FINER)
        contact = first_contact(checker, checked)
        if contact is None:
            clearance = least_clearance(checker, checked)
            return Approach(waypoints, goal_index, checked, clearance, seed, attempt + 1)
        refused = f"on a closer look {contact.body} touches {contact.other} on the way"
    raise NoAnswerError(f"approach not found: {refused} (seed {seed})")


def dense_states(checker: StateChecker, waypoints: Array, step_rad: float) -> Array:
    """States along a path, so close that neither joint distance nor any body's motion exceeds its bound.

    Args:
        checker: Knows the bodies.
        waypoints: Shape (k, 6), rad.
        step_rad: Largest joint distance between two states; ``MAX_SWEEP_MM`` bounds the bodies.

    Returns:
        Shape (m, 6), rad, all waypoints among them.
    """
    parts = [waypoints[:1]]
    for start, end in pairwise(waypoints):
        count = max(1, math.ceil(float(np.linalg.norm(end - start)) / step_rad))
        while (worst := checker.sweep_mm(_line(start, end, count)).max()) > MAX_SWEEP_MM:
            count = math.ceil(count * float(worst) / MAX_SWEEP_MM)
        parts.append(_line(start, end, count)[1:])
    return np.concatenate(parts)


def first_contact(checker: StateChecker, q_path: Array) -> Contact | None:
    """The first contact along states (m, 6), the needle being outside the patient; None if all are free."""
    met = checker.first_contact(q_path, needle_may_touch_patient=False)
    return None if met is None else met.contact


def least_clearance(checker: StateChecker, q_path: Array) -> Distances:
    """The least of each distance over states along a path, to ``CLEARANCE_STEP_MM``.

    Args:
        checker: Judges distances.
        q_path: Shape (m, 6), rad.
    """
    moved = {body: np.concatenate([[0.0], np.cumsum(sweep)]) for body, sweep in checker.body_sweeps_mm(q_path).items()}
    return Distances(*(_least(checker, q_path, moved, pair) for pair in DISTANCE_PAIRS))


def _least(checker: StateChecker, q_path: Array, moved: Mapping[str, Array], pair: str) -> Nearest:
    """A body's distance changes by no more than the body moves: from room to spare, whole stretches are skipped.

    ``moved`` is each body's way up to each state, shape (m,), mm.
    """
    starts = sorted((checker.nearest(q_path[0], pair, body), body) for body in DISTANCE_PAIRS[pair])
    best = starts[0][0]
    for here, body in starts:
        at = 0
        while np.isfinite(here.mm):
            out_of_reach = moved[body][at] + (here.mm - best.mm) + CLEARANCE_STEP_MM
            at = max(at + 1, int(np.searchsorted(moved[body], out_of_reach)))
            if at >= len(q_path):
                break
            here = checker.nearest(q_path[at], pair, body)
            best = min(best, here)
    return best


def _within_limits(checker: StateChecker, q: Array, name: str) -> Array:
    rows = np.atleast_2d(np.asarray(q, dtype=np.float64))
    if rows.ndim != 2 or rows.shape[1] != 6 or not checker.model.within_limits(rows).all() or len(rows) == 0:
        limits = np.round(np.degrees(checker.model.joint_limits[:, 1])).astype(int).tolist()
        raise InputError(f"{name} = {rows.round(4).tolist()}", where="approach", allowed=f"six angles, +-{limits} deg")
    return rows


def _refuse_contact(checker: StateChecker, home: Array, goals: Array) -> None:
    contact = checker.contact(home, needle_may_touch_patient=False)
    if contact is not None:
        raise NoAnswerError(f"home is in collision: {contact.body} touches {contact.other}")
    contacts = [checker.contact(goal, needle_may_touch_patient=False) for goal in goals]
    if all(contacts):
        named = sorted({f"{contact.body} touches {contact.other}" for contact in contacts if contact})
        raise NoAnswerError(f"every goal is in collision: {', '.join(named)}")


def _plan(
    checker: StateChecker, home: Array, goals: Array, seed: int, max_iterations: int, resolution_rad: float
) -> Array | None:
    """One run of the planner and its shortcuts: waypoints (k, 6), or None."""
    with _quiet_ompl():
        ou.RNG.setSeed(1 + seed % SEEDS)
        information = _space_information(checker, resolution_rad)
        problem = ob.ProblemDefinition(information)
        problem.addStartState(_state(information, home))
        goal_states = ob.GoalStates(information)
        for goal in goals:
            if checker.contact(goal, needle_may_touch_patient=False) is None:
                goal_states.addState(_state(information, goal))
        problem.setGoal(goal_states)
        planner = og.RRTConnect(information)
        planner.setRange(RANGE_RAD)
        planner.setProblemDefinition(problem)
        planner.setup()
        calls = iter(range(max_iterations))
        planner.solve(ob.PlannerTerminationCondition(lambda: next(calls, None) is None))
        if not problem.hasExactSolution():
            return None
        path = problem.getSolutionPath()
        _shorten(information, path)
        return np.array([[state[joint] for joint in range(6)] for state in path.getStates()])


def _space_information(checker: StateChecker, resolution_rad: float) -> ob.SpaceInformation:
    bounds = ob.RealVectorBounds(6)
    for joint, (low, high) in enumerate(checker.model.joint_limits):
        bounds.setLow(joint, float(low))
        bounds.setHigh(joint, float(high))
    space = ob.RealVectorStateSpace(6)
    space.setBounds(bounds)

    def free(state: ob.State) -> bool:
        q = np.array([state[joint] for joint in range(6)])  # only 0..5: beyond them OMPL reads garbage
        return checker.contact(q, needle_may_touch_patient=False) is None

    information = ob.SpaceInformation(space)
    information.setStateValidityChecker(free)
    information.setStateValidityCheckingResolution(resolution_rad / space.getMaximumExtent())
    information.setup()
    return information


def _shorten(information: ob.SpaceInformation, path: og.PathGeometric) -> None:
    """Shortcuts by numbers of steps, never by time."""
    simplifier = og.PathSimplifier(information)
    simplifier.reduceVertices(path)
    simplifier.partialShortcutPath(path)
    simplifier.reduceVertices(path)


def _state(information: ob.SpaceInformation, q: Array) -> ob.State:
    state = information.allocState()
    for joint in range(6):
        state[joint] = float(q[joint])
    return state


def _with_exact_ends(path: Array, home: Array, goals: Array) -> tuple[Array, int]:
    """The planner's path with home and its goal put in exactly, after a look that it is one."""
    waypoints = np.asarray(path, dtype=np.float64)
    off = np.abs(goals - waypoints[-1]).max(axis=1)
    goal_index = int(np.argmin(off))
    from_home = np.abs(waypoints[0] - home).max()
    if len(waypoints) < 2 or max(from_home, off[goal_index]) > END_TOLERANCE_RAD:
        raise NoAnswerError(f"the planner's path does not join home and goal: {from_home:.3g}, {off.min():.3g} rad off")
    waypoints = np.concatenate([home[None], waypoints[1:-1], goals[goal_index][None]])
    return waypoints, goal_index


def _line(start: Array, end: Array, count: int) -> Array:
    line = start + np.linspace(0.0, 1.0, count + 1)[:, None] * (end - start)
    line[-1] = end
    return line


@contextmanager
def _quiet_ompl() -> Iterator[None]:
    """OMPL's own messages off, then as before. Reseeding makes it complain; a test holds that it works all the same."""
    level = ou.getLogLevel()
    ou.setLogLevel(ou.LOG_NONE)
    try:
        yield
    finally:
        ou.setLogLevel(level)
