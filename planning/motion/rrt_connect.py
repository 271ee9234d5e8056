"""RRT-Connect, by OMPL, over straight joint segments that a given check decides; and OMPL's shortcuts of a path.

Source: Kuffner and LaValle 2000, "RRT-Connect: an efficient approach to single-query path planning".

Nothing here depends on the clock: the planner stops after a number of samples, or when one of its trees has not grown
for some of them in a row, so the same seed gives the same path.
OMPL keeps one random generator for the whole process and reseeds it here; two plans must not run in two threads.

OMPL measures distances with the wrist's joints counted for half: what an arm touches is decided by the first three
joints most of the time, and branches that reach farther in those pass a gap sooner.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from ompl import base as ob, geometric as og, util as ou

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.collision.bodies import Contact

RANGE_RAD = 1.0
"""Longest branch of the planner's trees, with the wrist's joints counted for half."""
END_TOLERANCE_RAD = 1e-9
"""How far the planner's ends may be from home and goal: rounding."""
HOME_TREE, GOAL_TREE = 0, 1
"""The planner's two trees."""
STALLED = 1000
"""When so many samples in a row have made a tree no larger, it is taken to be shut in. Next to a gantry, where most
branches touch something, a tree that later found its exit grew every 25 samples."""


class Connected(NamedTuple):
    """Result of one run of the planner."""

    waypoints: Floats | None
    """Shape (k, 6), rad: from home exactly to a goal exactly; None if it found no path."""
    goal_index: int  # which goal; -1 without a path
    home_states: int  # how many states the tree from home has
    goal_states: int  # how many the one from the goals has
    samples: int  # how many samples it took
    blocked: Counter[Contact]  # what its segments touched, and how often


class Limits(NamedTuple):
    """Sampling box and stopping rule of a run."""

    bounds: Floats  # shape (6, 2), rad: where samples are drawn; home and goals lie in it
    max_samples: int  # after so many the planner gives up
    shorter_than: float = math.inf
    """States through which no path to a goal is shorter than this, rad, are passed over unchecked."""


def connect(
    contact_of: SegmentContact,
    home: Floats,
    goals: Floats,
    limits: Limits,
    *,
    seed: int,
    clear_of: SegmentContact | None = None,
) -> Connected:
    """Plan from home (6,) to any of several goals (g, 6), free, rad, and shorten what was found.

    ``clear_of`` checks a shortcut; ``contact_of`` unless stated.

    Raises:
        NoAnswerError: If the planner's path does not join home and a goal.
    """
    with seeded(seed):
        space = JointSpace(limits.bounds)
        validator = _Validator(space.information, contact_of, home, goals, limits)
        space.set_up(validator)
        problem = ob.ProblemDefinition(space.information)
        problem.addStartState(space.state(home))
        goal_states = ob.GoalStates(space.information)
        for goal in goals:
            goal_states.addState(space.state(goal))
        problem.setGoal(goal_states)
        planner = og.RRTConnect(space.information)
        planner.setRange(RANGE_RAD)
        planner.setProblemDefinition(problem)
        planner.setup()
        planner.solve(ob.PlannerTerminationCondition(validator.next_sample))
        of_home, of_goals = validator.grown
        none = Connected(None, -1, of_home, of_goals, validator.samples, validator.blocked)
        if not problem.hasExactSolution():
            return none
        states = np.array([angles_of(state) for state in problem.getSolutionPath().getStates()])
        waypoints, goal_index = _with_exact_ends(states, home, goals)
        waypoints = shortened(limits.bounds, clear_of or contact_of, waypoints)
    return none._replace(waypoints=_with_exact_ends(waypoints, home, goals)[0], goal_index=goal_index)


class _Validator(ob.MotionValidator):  # type: ignore[misc]  # compiled, without types
    """Hands segments to a check, and counts samples, contacts and how the trees grow.

    A free segment from a state of a tree makes its other end a state of that tree. OMPL asks about a branch of the tree
    from the goals the other way round, toward that tree.
    """

    def __init__(
        self, information: ob.SpaceInformation, contact_of: SegmentContact, home: Floats, goals: Floats, limits: Limits
    ) -> None:
        super().__init__(information)  # and not kept: it keeps the validator, and no one would free the two
        self._contact_of, self._limits = contact_of, limits
        self._home, self._goals = tuple(home.tolist()), [tuple(goal) for goal in goals.tolist()]
        self._tree_of = dict.fromkeys(self._goals, GOAL_TREE) | {self._home: HOME_TREE}
        self._grew_at = [0, 0]
        self.samples = 0
        self.grown = [1, len(goals)]
        self.blocked: Counter[Contact] = Counter()

    def next_sample(self) -> bool:
        """Counts the planner's samples; whether to stop instead, after so many or where a tree has stalled."""
        if self.samples >= self._limits.max_samples or self.samples - min(self._grew_at) >= STALLED:
            return True
        self.samples += 1
        return False

    def checkMotion(self, start: ob.State, end: ob.State) -> bool:  # noqa: N802  # OMPL's name
        known, new = angles_of(start), angles_of(end)
        if known not in self._tree_of:
            known, new = (new, known) if new in self._tree_of else (known, new)
        left = self._limits.shorter_than - math.dist(self._home, new)
        if left < math.inf and all(math.dist(new, goal) >= left for goal in self._goals):
            return False  # no path through it is short enough (Gammell, Srinivasa and Barfoot 2014)
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


def _with_exact_ends(waypoints: Floats, home: Floats, goals: Floats) -> tuple[Floats, int]:
    """The planner's path with home and its goal put in exactly, after a look that it is one."""
    off = np.abs(goals - waypoints[-1]).max(axis=1)
    goal_index = int(np.argmin(off))
    from_home = np.abs(waypoints[0] - home).max()
    if len(waypoints) < 2 or max(from_home, off[goal_index]) > END_TOLERANCE_RAD:
        what = f"the planned path does not connect home and goal: {from_home:.3g}, {off.min():.3g} rad off"
        raise NoAnswerError(what, code="no_approach")
    return np.concatenate([home[None], waypoints[1:-1], goals[goal_index][None]]), goal_index


SegmentContact = Callable[[Floats, Floats], Contact | None]
"""Contact of the straight joint segment between two states (6,); None when it is free, its end included. Of a
segment that begins at a state known to be free the check gets that state first."""
Angles = tuple[float, ...]
"""Six joint angles, rad."""
WRIST_DIVISOR = 2.0
"""OMPL's coordinates of the wrist's three joints are their angles over this: a power of two, so that no bit is lost."""
SEEDS = 2**31 - 1
"""OMPL takes positive seeds; 0 would mean its own choice."""


class JointSpace:
    """A box of joint angles as OMPL sees it, those of the wrist divided by a power of two."""

    def __init__(self, bounds: Floats, wrist_divisor: float = WRIST_DIVISOR) -> None:
        self._divisors = np.array([1.0, 1.0, 1.0, wrist_divisor, wrist_divisor, wrist_divisor])
        box = ob.RealVectorBounds(6)
        for joint, (low, high) in enumerate((bounds / self._divisors[:, None]).tolist()):
            box.setLow(joint, low)
            box.setHigh(joint, high)
        space = ob.RealVectorStateSpace(6)
        space.setBounds(box)
        self.information = ob.SpaceInformation(space)
        self.information.setStateValidityChecker(lambda _: True)  # a segment is checked with its end

    def set_up(self, validator: ob.MotionValidator) -> None:
        """Have segments checked by a validator."""
        self.information.setMotionValidator(validator)
        self.information.setup()

    def state(self, q: Floats) -> ob.State:
        """A new state at angles (6,), rad."""
        state = self.information.allocState()
        for joint, value in enumerate((q / self._divisors).tolist()):
            state[joint] = value
        return state


def angles_of(state: ob.State, wrist_divisor: float = WRIST_DIVISOR) -> Angles:
    """The angles of a state, rad. Beyond six coordinates OMPL reads garbage."""
    wrist = wrist_divisor * state[3], wrist_divisor * state[4], wrist_divisor * state[5]
    return state[0], state[1], state[2], *wrist


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """OMPL's one generator seeded, and its messages off: reseeding makes it complain; a test holds that it works."""
    level = ou.getLogLevel()
    ou.setLogLevel(ou.LOG_NONE)
    try:
        ou.RNG.setSeed(1 + seed % SEEDS)
        yield
    finally:
        ou.setLogLevel(level)


ROUNDS = 2
"""Rounds of shortcuts."""
STEPS = 60
"""Shortcuts tried in each round. By itself OMPL tries as many as the path has vertices: few where branches are long."""
CLEARANCE_MM = 20.0
"""What a shortcut keeps from patient and boxes beyond the arm's padding, where both of its ends do. The shortest path
round an obstacle runs along it, and then an arm that errs by more than the padding touches."""
UNSCALED = 1.0
"""What the wrist's angles are divided by here: nothing."""


def shortened(joint_limits: Floats, contact_of: SegmentContact, waypoints: Floats) -> Floats:
    """A path (m, 6), rad, with the ends of one of straight free segments (k, 6), and not longer than it.

    Every joint counts in full for the length; ``joint_limits`` are (6, 2), rad.
    """
    space = JointSpace(joint_limits, UNSCALED)
    space.set_up(_ShortcutValidator(space.information, contact_of))
    path = og.PathGeometric(space.information)
    for q in waypoints:
        path.append(space.state(q))
    simplifier = og.PathSimplifier(space.information)
    simplifier.reduceVertices(path)
    for _ in range(ROUNDS):
        simplifier.partialShortcutPath(path, STEPS, STEPS)
        simplifier.reduceVertices(path)
    simplifier.collapseCloseVertices(path)  # corners close together are taken slowly
    return np.array([angles_of(state, UNSCALED) for state in path.getStates()])


class _ShortcutValidator(ob.MotionValidator):  # type: ignore[misc]  # compiled, without types
    def __init__(self, information: ob.SpaceInformation, contact_of: SegmentContact) -> None:
        super().__init__(information)  # and not kept: it keeps the validator, and no one would free the two
        self._contact_of = contact_of

    def checkMotion(self, start: ob.State, end: ob.State) -> bool:  # noqa: N802  # OMPL's name
        ends = angles_of(start, UNSCALED), angles_of(end, UNSCALED)
        return self._contact_of(np.array(ends[0]), np.array(ends[1])) is None
