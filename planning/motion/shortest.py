"""The shortest path found to any of several goals: straight, or by runs of the planner that each seek a shorter one."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.motion.cut import Cut
from puncture_twin.planning.motion.joint_space import SegmentContact
from puncture_twin.planning.motion.path_check import path_length
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
        return path_length(self.waypoints)


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


def shortest_path(task: Task, *, seed: int, max_samples: int = MAX_SAMPLES) -> Path | Connected:
    """The shortest path found to any goal, or what the run came to that found none.

    No path is shorter than the straight line to its goal, so once there is one, only goals nearer than it is long are
    sought.

    Args:
        task: What is sought.
        seed: Of OMPL's generator.
        max_samples: Of the planner, in each of its runs.
    """
    away = np.linalg.norm(task.goals - task.home, axis=1)
    nearest_first = np.argsort(away, kind="stable")
    best = _straight(task, nearest_first.tolist())
    for run in range(RUNS):
        sought = nearest_first if best is None else nearest_first[away[nearest_first] * SHORT_ENOUGH < best.length]
        if len(sought) == 0:
            break
        sought = np.sort(sought)  # without a path yet, all of them: as the cut has them
        found = _run(task._replace(goals=task.goals[sought]), best, seed + run, max_samples)
        if found.waypoints is None:
            return found if best is None else best
        max_samples = min(max_samples, max(LEAST_SAMPLES, PATIENCE * found.samples))
        path = Path(found.waypoints, int(sought[found.goal_index]))
        best = path if best is None or path.length < best.length else best
    assert best is not None  # the first run has returned without one
    return best


def _straight(task: Task, nearest_first: list[int]) -> Path | None:
    """The straight path to the nearest goal that has a free one."""
    for goal in nearest_first:
        if task.contact_of(task.home, task.goals[goal]) is None:
            return Path(np.stack([task.home, task.goals[goal]]), goal)
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
