"""How far the bodies of an arm move between two configurations: the bound behind every sampled collision check."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from planning.robot.kinematics import link_poses
from planning.robot.links import collision_links
from planning.robot.tool import Tool
from planning.robot.ur import UrModel

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SweptBodies:
    """Boxes about the moving bodies, to bound their motion.

    Attributes:
        model: The arm.
        tool: What its flange carries.
        corners: Shape (6, 8, 3), mm: a box about each moving link in its frame, the last one with holder and needle.
    """

    model: UrModel
    tool: Tool
    corners: Array

    @classmethod
    def of(cls, model: UrModel, tool: Tool) -> SweptBodies:
        """The boxes about a model's links and a tool."""
        boxes = [link.mesh.bounds for link in collision_links(model)[1:]]
        radius = max(tool.holder_diameter_mm, tool.needle_diameter_mm) / 2.0
        reach = np.array([[-radius, -radius, tool.holder_span_mm[0]], [radius, radius, tool.needle_length_mm]])
        boxes[-1] = np.stack([np.minimum(boxes[-1][0], reach[0]), np.maximum(boxes[-1][1], reach[1])])
        return cls(model, tool, np.stack([np.array(list(product(*box.T))) for box in boxes]))

    def bounds_mm(self, q_path: Array) -> Array:
        """A bound on the motion of every point of each link along each straight joint segment of a path.

        Along a segment each point stays within half this bound of where it is at one of the two ends: the farthest
        chord of a box corner (a rigid displacement is affine, so a corner moves farthest), plus twice the sag of the
        curve over its chord, at most (sum of joint steps)^2 times the longest lever / 8. It also bounds how far a
        point ends up from where it started.

        Args:
            q_path: Shape (m, 6), rad.

        Returns:
            Shape (m - 1, 6), mm: shoulder, ..., wrist 3 with the tool.
        """
        poses = link_poses(self.model, q_path)[:, 1:]
        corners = np.einsum("mlij,lkj->mlki", poses[..., :3, :3], self.corners) + poses[..., None, :3, 3]
        chords = np.linalg.norm(np.diff(corners, axis=0), axis=-1).max(axis=2)
        turned = np.cumsum(np.abs(np.diff(q_path, axis=0)), axis=1)
        return np.asarray(chords + 2.0 * turned**2 * self.longest_lever_mm / 8.0)

    @property
    def longest_lever_mm(self) -> float:
        """No body point is ever farther from a joint's axis than this, mm."""
        m = self.model
        chain = abs(m.a2) + abs(m.a3) + m.d4 + m.d5 + m.d6
        return float(chain + np.linalg.norm(self.corners, axis=-1).max())
