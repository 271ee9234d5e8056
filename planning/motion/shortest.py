"""The shortest path found to any of several goals, or the proof that the upper arm cannot pass.

`shortest_path` tries straight lines, then runs of the planner that each seek a shorter path.

Proof (`Cut`). The upper arm's place depends on the first two joints alone, whose angles are divided into cells. In a
blocked cell one point of the upper arm lies, at the middle, deeper in a box than it can move within the cell, so the
upper arm is in that box all over the cell. A path's first two angles pass from cell to cell, so a free one stays in one
connected part of the cells that are not blocked. Where home and a goal lie in different parts there is no path.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise, starmap
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.tool import Box
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.geometry.rigid import apply, inverse
from puncture_twin.planning.motion.rrt_connect import Connected, Limits, SegmentContact, connect

MAX_SAMPLES = 8000
"""Samples of the first run; half of them near home and goals. Next to the body tens of them do, at a gantry
some hundred."""
NEAR_RAD = math.pi
"""How far beyond the angles of home and goals a joint may turn while half of the samples are drawn: half a turn. The
limits of most joints are two whole turns apart, and a way round oneself is seldom needed."""
PATIENCE, LEAST_SAMPLES = 4, 500
"""A run for a shorter path gets so many times the samples that the first one took, or at least so many."""
RUNS = 3
"""Runs of the planner, while it might find a path that is much shorter; see ``SHORT_ENOUGH``."""
SHORT_ENOUGH = 1.3
"""No run seeks a path shorter than one that is this many times as long as the straight line to the nearest goal."""


class Path(NamedTuple):
    """Straight segments from home to a goal."""

    waypoints: Floats
    goal_index: int

    @property
    def length(self) -> float:
        """Length of the joints' path, rad."""
        return math.fsum(starmap(math.dist, pairwise(self.waypoints.tolist())))


class Task(NamedTuple):
    """A planning problem: ends, limits and checks of a path."""

    joint_limits: Floats  # shape (6, 2), rad
    contact_of: SegmentContact
    home: Floats  # shape (6,), rad, free
    goals: Floats  # shape (g, 6), rad, free
    cut: Cut | None = None  # the proof of which goals are cut off from home
    clear_of: SegmentContact | None = None  # checks a shortcut; None for the check of a segment


def direct_path(contact_of: SegmentContact, home: Floats, goals: Floats) -> Path | None:
    """The straight path to the nearest goal that has a free one, where no other goal is worth a search; else None.

    From home (6,), free, to goals (g, 6), rad. It ends where its check has found no contact: whether goals are free
    need not be known.
    """
    away = _distances(home, goals)
    path = _straight(contact_of, home, goals, away)
    return path if path is not None and min(away) * SHORT_ENOUGH >= path.length else None


def shortest_path(task: Task, *, seed: int, max_samples: int = MAX_SAMPLES) -> Path | Connected:
    """The shortest path found to any goal, or the result of the run that found none.

    No path is shorter than the straight line to its goal, so once there is one, only goals nearer than it is long are
    sought.
    """
    away = _distances(task.home, task.goals)
    best = _straight(task.contact_of, task.home, task.goals, away)
    for run in range(RUNS):
        enough = math.inf if best is None else best.length
        sought = [goal for goal, straight in enumerate(away) if straight * SHORT_ENOUGH < enough]  # worth a run
        if not sought:
            break
        connected = _run(task._replace(goals=task.goals[sought]), best, seed + run, max_samples)
        if connected.waypoints is None:
            return connected if best is None else best
        max_samples = min(max_samples, max(LEAST_SAMPLES, PATIENCE * connected.samples))
        path = Path(connected.waypoints, sought[connected.goal_index])
        best = path if best is None or path.length < best.length else best
    assert best is not None  # the first run has returned without one
    return best


def _distances(home: Floats, goals: Floats) -> list[float]:
    start = home.tolist()
    return [math.dist(start, goal) for goal in goals.tolist()]


def _straight(contact_of: SegmentContact, home: Floats, goals: Floats, away: list[float]) -> Path | None:
    for goal in sorted(range(len(away)), key=away.__getitem__):
        if contact_of(home, goals[goal]) is None:
            return Path(np.array([home, goals[goal]]), goal)
    return None


def _run(task: Task, best: Path | None, seed: int, max_samples: int) -> Connected:
    """One run of the planner: where a path shorter than the best can lie; without one near home and goals first."""
    if best is not None:
        spare = (best.length - np.abs(task.goals - task.home)).max(axis=0) / 2.0  # there and back along one joint
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


UPPER_ARM = "upper_arm"
UPPER_ARM_FRAME = 2
"""Its row among ``link_poses``: the joints before it are the first two."""
CELL_RAD = np.radians(5.0)
"""Largest width of a cell: at the elbow a turn by half of it moves a UR3's upper arm by 11 mm."""
MOST_POINTS = 48
"""Points of the upper arm that are tested."""
SLACK_MM = 0.01
"""A point must lie deeper than it moves by this: rounding, and what FCL may take for no contact."""
SAME_ANGLE = 1e-9
"""Angles this near to each other, whole turns apart, are one."""


class Cut:
    """Which goals are cut off from home, and by which boxes; found when it is first needed.

    Shown by points (p, 3), mm, that lie within the upper arm, in its frame.
    """

    def __init__(self, model: UrModel, boxes: Sequence[Box], points: Floats, home: Floats, goals: Floats) -> None:
        self._model, self._boxes, self._home, self._goals = model, boxes, home, goals
        self._points = points[:: max(1, -(-len(points) // MOST_POINTS))]  # rounded up: at most that many

    @cached_property
    def off(self) -> Bools:
        """Shape (g,): whether a goal is proven to be cut off."""
        at_home, at_goals = self._part(self._home), np.array([self._part(goal) for goal in self._goals])
        return np.asarray((at_home > 0) & (at_goals > 0) & (at_goals != at_home))

    @property
    def text(self) -> str:
        """Boxes that the upper arm would have to pass: those in the cells around home's."""
        around = ndimage.binary_dilation(self._parts == self._part(self._home), np.ones((3, 3)))
        named = Counter(self._boxes[box].name for box in self._blocking[around & (self._blocking >= 0)].tolist())
        return f"in every configuration, {UPPER_ARM} would have to pass through " + " or ".join(sorted(named))

    @cached_property
    def _edges(self) -> list[Floats]:
        limits = self._model.joint_limits[:2]
        return [np.linspace(low, high, int(np.ceil((high - low) / CELL_RAD)) + 1) for low, high in limits]

    @cached_property
    def _blocking(self) -> Ints:
        """Shape (m, n): of each cell the row of a box that the upper arm is in all over it; -1 where none is proven."""
        middles = [(edges[1:] + edges[:-1]) / 2.0 for edges in self._edges]
        halves = [float(np.diff(edges).max()) / 2.0 for edges in self._edges]
        (first, first_rows), (second, second_rows) = (_modulo_turns(middle) for middle in middles)
        q = np.zeros((len(first), len(second), 6))
        q[..., 0], q[..., 1] = first[:, None], second
        poses = link_poses(self._model, q.reshape(-1, 6))
        # the points (c, p, 3) at each cell's middle, mm, and their distances (c, p) to the axes of both joints
        frames = poses[:, UPPER_ARM_FRAME]
        points = np.einsum("cij,pj->cpi", frames[:, :3, :3], self._points) + frames[:, None, :3, 3]
        origins, axes = poses[:, None, :2, :3, 3], poses[:, None, :2, :3, 2]
        levers = np.moveaxis(np.linalg.norm(np.cross(points[:, :, None] - origins, axes), axis=-1), -1, 0)
        moved = halves[1] * levers[1] + halves[0] * (levers[0] + halves[1] * levers[1])
        blocking = np.full(len(points), -1)
        for row, box in enumerate(self._boxes):
            inside = np.asarray(box.size_mm) / 2.0 - np.abs(apply(inverse(box.T_base_box), points))
            blocking[(inside.min(axis=-1) > moved + SLACK_MM).any(axis=1)] = row
        return blocking.reshape(len(first), len(second))[first_rows][:, second_rows]

    @cached_property
    def _parts(self) -> Ints:
        """Shape (m, n): which part a cell belongs to, cells that share a corner hanging together; 0 where blocked."""
        return np.asarray(ndimage.label(self._blocking < 0, np.ones((3, 3)))[0])

    def _part(self, q: Floats) -> int:
        cell = [
            min(max(int(np.searchsorted(edges, angle, side="right")) - 1, 0), len(edges) - 2)
            for edges, angle in zip(self._edges, q.tolist(), strict=False)
        ]
        return int(self._parts[cell[0], cell[1]])


def _modulo_turns(angles: Floats) -> tuple[Floats, Ints]:
    """Distinct angles modulo whole turns, and the index of each angle's."""
    turns = np.round((angles % (2.0 * np.pi)) / SAME_ANGLE).astype(np.int64)
    _, rows, which = np.unique(turns, return_index=True, return_inverse=True)
    return angles[rows], which
