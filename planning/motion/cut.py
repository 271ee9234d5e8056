"""A proof that no path leads from home to a goal: whatever the other joints do, the upper arm cannot get by.

The upper arm's place depends on the first two joints alone. Their angles are divided into cells. In a blocked cell one
point of the upper arm lies, at the middle, deeper in a box than it can move within the cell, so the upper arm is in
that box all over the cell. A path's first two angles pass from cell to cell, so one that is free stays among the cells
that are not blocked and hang together. Where home and a goal are not among the same of them there is no path.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy import ndimage

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.tool import Box
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.geometry.rigid import apply, inverse

UPPER_ARM = "upper_arm"
UPPER_ARM_FRAME = 2
"""Its row among ``link_poses``: the joints before it are the first two."""

CELL_RAD = np.radians(5.0)
"""Largest width of a cell: at the elbow a turn by half of it moves a UR3's upper arm by 11 mm."""

MOST_POINTS = 48
"""Of the upper arm that are looked at."""

SLACK_MM = 0.01
"""A point must lie deeper than it moves by this: rounding, and what FCL may take for no contact."""

SAME_ANGLE = 1e-9
"""Angles this near to each other, whole turns apart, are one."""


class Cut:
    """Which goals are cut off from home, and by which boxes; found when it is first wanted.

    Args:
        model: The arm.
        boxes: The solids of its workcell.
        points: Shape (p, 3), mm: points within the upper arm, in its frame.
        home: Shape (6,), rad.
        goals: Shape (g, 6), rad.
    """

    def __init__(self, model: UrModel, boxes: Sequence[Box], points: Floats, home: Floats, goals: Floats) -> None:
        self._model, self._boxes, self._home, self._goals = model, boxes, home, goals
        self._points = points[:: max(1, -(-len(points) // MOST_POINTS))]

    @cached_property
    def off(self) -> Bools:
        """Shape (g,): whether a goal is proven to be cut off."""
        at_home, at_goals = self._part(self._home), np.array([self._part(goal) for goal in self._goals])
        return np.asarray((at_home > 0) & (at_goals > 0) & (at_goals != at_home))

    @property
    def text(self) -> str:
        """What the upper arm would have to pass through: the boxes in the cells around those of home."""
        around = ndimage.binary_dilation(self._parts == self._part(self._home), np.ones((3, 3)))
        named = Counter(self._boxes[box].name for box in self._blocking[around & (self._blocking >= 0)].tolist())
        return f"whatever the other joints do, {UPPER_ARM} would have to pass through " + " or ".join(sorted(named))

    @cached_property
    def _edges(self) -> list[Floats]:
        """Of the cells, by joint."""
        limits = self._model.joint_limits[:2]
        return [np.linspace(low, high, int(np.ceil((high - low) / CELL_RAD)) + 1) for low, high in limits]

    @cached_property
    def _blocking(self) -> Ints:
        """Shape (m, n): of each cell the row of a box that the upper arm is in all over it; -1 where none is proven."""
        middles = [(edges[1:] + edges[:-1]) / 2.0 for edges in self._edges]
        halves = [float(np.diff(edges).max()) / 2.0 for edges in self._edges]
        (first, first_rows), (second, second_rows) = (_unturned(middle) for middle in middles)
        q = np.zeros((len(first), len(second), 6))
        q[..., 0], q[..., 1] = first[:, None], second
        poses = link_poses(self._model, q.reshape(-1, 6))
        points, levers = self._placed(poses)
        moved = halves[1] * levers[1] + halves[0] * (levers[0] + halves[1] * levers[1])
        found = np.full(len(points), -1)
        for row, box in enumerate(self._boxes):
            inside = np.asarray(box.size_mm) / 2.0 - np.abs(apply(inverse(box.T_base_box), points))
            found[(inside.min(axis=-1) > moved + SLACK_MM).any(axis=1)] = row
        return found.reshape(len(first), len(second))[first_rows][:, second_rows]

    def _placed(self, poses: Floats) -> tuple[Floats, Floats]:
        """The points (c, p, 3) at each cell's middle, mm, and their distances (2, c, p) to the axes of both joints."""
        frames = poses[:, UPPER_ARM_FRAME]
        points = np.einsum("cij,pj->cpi", frames[:, :3, :3], self._points) + frames[:, None, :3, 3]
        levers = [
            np.linalg.norm(np.cross(points - poses[:, None, joint, :3, 3], poses[:, None, joint, :3, 2]), axis=-1)
            for joint in range(2)
        ]
        return points, np.array(levers)

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


def _unturned(angles: Floats) -> tuple[Floats, Ints]:
    """The different ones of some angles but for whole turns, and which of them each is."""
    turns = np.round((angles % (2.0 * np.pi)) / SAME_ANGLE).astype(np.int64)
    _, rows, which = np.unique(turns, return_index=True, return_inverse=True)
    return angles[rows], which
