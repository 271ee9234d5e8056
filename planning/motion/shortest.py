"""The shortest path found to any of several goals: straight, or by runs of the planner that each seek a shorter one."""

from __future__ import annotations

import math
from itertools import pairwise, starmap
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.motion.cut import Cut
from puncture_twin.planning.motion.joint_space import SegmentContact
from puncture_twin.planning.motion.rrt_connect import Connected, Limits, connect

MAX_SAMPLES = 8000
"""Of the planner, in the first run; half of them near home and goals. Beside the body tens of them do, beside a gantry
some hundred."""

NEAR_RAD = math.pi
"""How far beyond the angles of home and goals a joint may turn while half of the samples are drawn: half a turn. The
limits of most joints are two whole turns apart, and a way round oneself is seldom needed."""

PATIENCE, LEAST_SAMPLES = 4, 500
"""A run for a shorter path gets so many times the samples that the first one took, or at least so many."""

RUNS = 3
"""Of the planner, while it might find a path that is much shorter; see ``SHORT_ENOUGH``."""

SHORT_ENOUGH = 1.3
"""No run seeks a path shorter than one that is this many times as long as the straight line to the nearest goal."""


class Path(NamedTuple):
    """Straight segments from home to a goal."""

    waypoints: Floats
    goal_index: int

    @property
    def length(self) -> float:
        """Of the joints' travel, rad."""
        return math.fsum(starmap(math.dist, pairwise(self.waypoints.tolist())))


class Task(NamedTuple):
    """What a path is sought for."""

    joint_limits: Floats
    """Shape (6, 2), rad."""
    contact_of: SegmentContact
    """Checks a segment."""
    home: Floats
    """Shape (6,), rad, free."""
    goals: Floats
    """Shape (g, 6), rad, free."""
    cut: Cut | None = None
    """Tells which of the goals are cut off from home."""
    clear_of: SegmentContact | None = None
    """Checks a shortcut; None for the check of a segment."""


def direct_path(contact_of: SegmentContact, home: Floats, goals: Floats) -> Path | None:
    """The straight path to the nearest goal that has a free one, where no other goal is worth a search; else None.

    It ends where its check has found no contact: whether goals are free need not be known.

    Args:
        contact_of: Checks a segment.
        home: Shape (6,), rad, free.
        goals: Shape (g, 6), rad.
    """
    away = _distances(home, goals)
    found = _straight(contact_of, home, goals, away)
    return found if found is not None and min(away) * SHORT_ENOUGH >= found.length else None


def shortest_path(task: Task, *, seed: int, max_samples: int = MAX_SAMPLES) -> Path | Connected:
    """The shortest path found to any goal, or what the run came to that found none.

    No path is shorter than the straight line to its goal, so once there is one, only goals nearer than it is long are
    sought.

    Args:
        task: What is sought.
        seed: Of OMPL's generator.
        max_samples: Of the planner, in each of its runs.
    """
    away = _distances(task.home, task.goals)
    best = _straight(task.contact_of, task.home, task.goals, away)
    for run in range(RUNS):
        enough = math.inf if best is None else best.length
        sought = [goal for goal, straight in enumerate(away) if straight * SHORT_ENOUGH < enough]
        if not sought:
            break
        found = _run(task._replace(goals=task.goals[sought]), best, seed + run, max_samples)
        if found.waypoints is None:
            return found if best is None else best
        max_samples = min(max_samples, max(LEAST_SAMPLES, PATIENCE * found.samples))
        path = Path(found.waypoints, sought[found.goal_index])
        best = path if best is None or path.length < best.length else best
    assert best is not None  # the first run has returned without one
    return best


def _distances(home: Floats, goals: Floats) -> list[float]:
    """From home to each goal, rad."""
    start = home.tolist()
    return [math.dist(start, goal) for goal in goals.tolist()]


def _straight(contact_of: SegmentContact, home: Floats, goals: Floats, away: list[float]) -> Path | None:
    """The straight path to the nearest goal that has a free one."""
    for goal in sorted(range(len(away)), key=away.__getitem__):
        if contact_of(home, goals[goal]) is None:
            return Path(np.array([home, goals[goal]]), goal)
    return None


def _run(task: Task, best: Path | None, seed: int, max_samples: int) -> Connected:
    """One run: where a path shorter than the best can lie; without one near home and goals first, then anywhere."""
    if best is not None:
        spare = (best.length - np.abs(task.goals - task.home)).max(axis=0) / 2.0
        limits = Limits(_box(task, spare.clip(0.0)), max_samples, best.length)
        return connect(task.contact_of, task.home, task.goals, limits, seed=seed, clear_of=task.clear_of)
    near = Limits(_box(task, NEAR_RAD), max_samples // 2)
    first = connect(task.contact_of, task.home, task.goals, near, seed=seed, clear_of=task.clear_of)
    if first.waypoints is not None:
        return first
    left = np.arange(len(task.goals)) if task.cut is None else np.flatnonzero(~task.cut.off)
    if len(left) == 0:
        return first
    anywhere = Limits(task.joint_limits, max_samples - near.max_samples)
    second = connect(task.contact_of, task.home, task.goals[left], anywhere, seed=seed, clear_of=task.clear_of)
    goal_index = -1 if second.waypoints is None else int(left[second.goal_index])
    both = first.samples + second.samples, first.blocked + second.blocked
    return second._replace(goal_index=goal_index, samples=both[0], blocked=both[1])


def _box(task: Task, margin_rad: Floats | float) -> Floats:
    """The angles of home and goals and a margin beyond, within the joint limits: shape (6, 2), rad."""
    ends = np.concatenate([task.home[None], task.goals])
    low, high = task.joint_limits.T
    return np.stack(
        [np.maximum(low, ends.min(axis=0) - margin_rad), np.minimum(high, ends.max(axis=0) + margin_rad)], axis=1
    )
