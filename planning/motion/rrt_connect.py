"""RRT-Connect and its shortcuts, by OMPL, over straight joint segments that somebody else checks.

Source: Kuffner and LaValle 2000, "RRT-Connect: an efficient approach to single-query path planning".

Nothing here depends on the clock: the planner stops after a number of samples, or when one of its trees has not grown
for some of them in a row, so the same seed gives the same path.
OMPL keeps one random generator for the whole process and reseeds it here; two plans must not run in two threads.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from ompl import base as ob, geometric as og, util as ou

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.collision.checker import Contact

SegmentContact = Callable[[Floats, Floats], Contact | None]
"""What the straight joint segment between two states (6,) meets; None when it is free, its end included. Of a segment
that begins at a state known to be free the check gets that state first."""

RANGE_RAD = 0.5
"""Longest branch of the planner's trees."""

END_TOLERANCE_RAD = 1e-9
"""How far the planner's ends may be from home and goal: rounding."""

SEEDS = 2**31 - 1
"""OMPL takes positive seeds; 0 would mean its own choice."""

HOME_TREE, GOAL_TREE = 0, 1
"""The planner's two trees."""

STALLED = 1000
"""When so many samples in a row have made a tree no larger, it is taken to be shut in. Beside a gantry, where most
branches touch something, a tree that later found its way out grew every 25 samples."""


class Connected(NamedTuple):
    """What one run of the planner came to."""

    waypoints: Floats | None
    """Shape (k, 6), rad: from home exactly to a goal exactly; None if it found no path."""
    goal_index: int
    """Which goal; -1 without a path."""
    home_states: int
    """How many states the tree from home has."""
    goal_states: int
    """How many the one from the goals has."""
    samples: int
    """How many samples it took."""
    blocked: Counter[Contact]
    """What its segments touched, and how often."""


def connect(
    joint_limits: Floats, contact_of: SegmentContact, home: Floats, goals: Floats, *, seed: int, max_samples: int
) -> Connected:
    """Plan from home to any of several goals, and shorten what was found.

    Args:
        joint_limits: Shape (6, 2), rad.
        contact_of: Checks a segment.
        home: Shape (6,), rad, free.
        goals: Shape (g, 6), rad, free.
        seed: Of OMPL's generator.
        max_samples: After so many the planner gives up.

    Raises:
        NoAnswerError: If the planner's path does not join home and a goal.
    """
    with _quiet_ompl():
        ou.RNG.setSeed(1 + seed % SEEDS)
        information = ob.SpaceInformation(_space(joint_limits))
        validator = _Validator(information, contact_of, home, goals)
        information.setStateValidityChecker(_everything)  # a segment is checked with its end
        information.setMotionValidator(validator)
        information.setup()
        problem = ob.ProblemDefinition(information)
        problem.addStartState(_state(information, home))
        goal_states = ob.GoalStates(information)
        for goal in goals:
            goal_states.addState(_state(information, goal))
        problem.setGoal(goal_states)
        planner = og.RRTConnect(information)
        planner.setRange(RANGE_RAD)
        planner.setProblemDefinition(problem)
        planner.setup()
        planner.solve(ob.PlannerTerminationCondition(lambda: validator.next_sample(max_samples)))
        of_home, of_goals = validator.grown
        none = Connected(None, -1, of_home, of_goals, validator.samples, validator.blocked)
        if not problem.hasExactSolution():
            return none
        path = problem.getSolutionPath()
        _shorten(information, path)
        found = np.array([_angles(state) for state in path.getStates()])
    waypoints, goal_index = _with_exact_ends(found, home, goals)
    return none._replace(waypoints=waypoints, goal_index=goal_index)


class _Validator(ob.MotionValidator):  # type: ignore[misc]  # compiled, without types
    """Hands segments to a check, and counts the contacts and how the trees grow.

    A free segment from a state of a tree makes its other end a state of that tree. OMPL asks about a branch of the tree
    from the goals the other way round, toward that tree.
    """

    def __init__(
        self, information: ob.SpaceInformation, contact_of: SegmentContact, home: Floats, goals: Floats
    ) -> None:
        super().__init__(information)
        self._contact_of = contact_of
        self._tree_of = {tuple(goal): GOAL_TREE for goal in goals.tolist()} | {tuple(home.tolist()): HOME_TREE}
        self._grew_at = [0, 0]
        self.samples = 0
        self.grown = [1, len(goals)]
        self.blocked: Counter[Contact] = Counter()

    def next_sample(self, most: int) -> bool:
        """Counts the planner's samples; whether to stop instead, after so many or where a tree has stalled."""
        if self.samples >= most or self.samples - min(self._grew_at) >= STALLED:
            return True
        self.samples += 1
        return False

    def checkMotion(self, start: ob.State, end: ob.State) -> bool:  # noqa: N802  # OMPL's name
        known, new = _angles(start), _angles(end)
        if known not in self._tree_of:
            known, new = (new, known) if new in self._tree_of else (known, new)
        contact = self._contact_of(np.array(known), np.array(new))
        if contact is not None:
            self.blocked[contact] += 1
            return False
        tree = self._tree_of.get(known)
        if tree is not None and new not in self._tree_of:
            self._tree_of[new] = tree
            self._grew_at[tree] = self.samples
            self.grown[tree] += 1
        return True


def _everything(state: ob.State) -> bool:
    return True


def _angles(state: ob.State) -> tuple[float, ...]:
    return state[0], state[1], state[2], state[3], state[4], state[5]  # beyond them OMPL reads garbage


def _space(joint_limits: Floats) -> ob.RealVectorStateSpace:
    bounds = ob.RealVectorBounds(6)
    for joint, (low, high) in enumerate(joint_limits):
        bounds.setLow(joint, float(low))
        bounds.setHigh(joint, float(high))
    space = ob.RealVectorStateSpace(6)
    space.setBounds(bounds)
    return space


def _state(information: ob.SpaceInformation, q: Floats) -> ob.State:
    state = information.allocState()
    for joint in range(6):
        state[joint] = float(q[joint])
    return state


def _shorten(information: ob.SpaceInformation, path: og.PathGeometric) -> None:
    """Shortcuts by numbers of steps, never by time."""
    simplifier = og.PathSimplifier(information)
    simplifier.reduceVertices(path)
    simplifier.partialShortcutPath(path)
    simplifier.reduceVertices(path)


def _with_exact_ends(waypoints: Floats, home: Floats, goals: Floats) -> tuple[Floats, int]:
    """The planner's path with home and its goal put in exactly, after a look that it is one."""
    off = np.abs(goals - waypoints[-1]).max(axis=1)
    goal_index = int(np.argmin(off))
    from_home = np.abs(waypoints[0] - home).max()
    if len(waypoints) < 2 or max(from_home, off[goal_index]) > END_TOLERANCE_RAD:
        raise NoAnswerError(f"the planner's path does not join home and goal: {from_home:.3g}, {off.min():.3g} rad off")
    return np.concatenate([home[None], waypoints[1:-1], goals[goal_index][None]]), goal_index


@contextmanager
def _quiet_ompl() -> Iterator[None]:
    """OMPL's own messages off, then as before. Reseeding makes it complain; a test holds that it works all the same."""
    level = ou.getLogLevel()
    ou.setLogLevel(ou.LOG_NONE)
    try:
        yield
    finally:
        ou.setLogLevel(level)
