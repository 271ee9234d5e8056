"""What collision checkers return, and bounds on how far an arm's bodies move.

`SweptBodies` bounds the motion between two configurations: every sampled collision check rests on it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import link_frames, link_poses
from puncture_twin.planning.arm.links import LINK_NAMES, collision_links
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.numba_kernels import allocation_free, nb

PATIENT = "patient"

BODY_NAMES = (*LINK_NAMES, "tool", "holder", "needle")
"""The bodies of the arm, from the base on; not every arm has a tool."""


class Contact(NamedTuple):
    """Two bodies that touch, such as ``("forearm", "patient")``; a body of the arm first."""

    body: str
    other: str


NEEDLE_IN_PATIENT = Contact("needle", PATIENT)
"""What may happen while the needle goes in."""


class FirstContact(NamedTuple):
    """The first contact along a path: at which of its states, and of what."""

    at: int  # index of the state
    contact: Contact


class Nearest(NamedTuple):
    """The smallest distance between the arm and something else; infinite, with empty names, where there is nothing."""

    mm: float
    body: str
    other: str


class Distances(NamedTuple):
    """Least distances of the arm, mm, 0 where it touches."""

    patient: Nearest  # moving links and holder to the skin
    needle: Nearest  # needle to the skin: 0 while it goes in
    boxes: Nearest  # moving links, holder and needle to the workcell's boxes


DISTANCE_PAIRS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"patient": BODY_NAMES[1:-1], "needle": BODY_NAMES[-1:], "boxes": BODY_NAMES[1:]}
)
"""The kinds of distance, by the fields of ``Distances``, and the bodies that each is measured from."""


def require_finite(q: Floats) -> None:
    """Refuse joint angles that are not finite: FCL would call them free."""
    if not np.isfinite(q).all():
        refuse(f"joint angles {q} are not finite", "collision check", "six angles in rad", "not_finite")


@dataclass(frozen=True, eq=False)
class SweptBodies:
    """Boxes about the moving bodies, to bound their motion."""

    model: UrModel
    tool: Tool
    corners: Floats
    """Shape (6, 8, 3), mm: a box about each moving link in its frame, the last with all on the flange."""
    longest_lever_mm: float  # no body point is ever farther from a joint's axis than this

    @classmethod
    def of(cls, model: UrModel, tool: Tool, padding_mm: float = 0.0) -> SweptBodies:
        """The boxes about a model's links and a tool, each grown by ``padding_mm`` on every side."""
        boxes = [link.mesh.bounds for link in collision_links(model)[1:]]
        radius = max(tool.holder_diameter_mm, tool.needle_diameter_mm) / 2.0
        reach = np.array([[-radius, -radius, tool.holder_span_mm[0]], [radius, radius, tool.needle_length_mm]])
        boxes[-1] = np.stack([np.minimum(boxes[-1][0], reach[0]), np.maximum(boxes[-1][1], reach[1])])
        if tool.body is not None:
            low, high = tool.body.mesh.bounds
            boxes[-1] = np.stack([np.minimum(boxes[-1][0], low), np.maximum(boxes[-1][1], high)])
        grown = [box + [[-padding_mm], [padding_mm]] for box in boxes]
        corners = np.stack([np.array(list(product(*box.T))) for box in grown])
        chain = abs(model.a2) + abs(model.a3) + model.d4 + model.d5 + model.d6
        return cls(model, tool, corners, float(chain + np.linalg.norm(corners, axis=-1).max()))

    def bounds_mm(self, q_path: Floats) -> Floats:
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
        path = np.array(q_path, dtype=np.float64, order="C")
        bounds = np.empty((len(path) - 1, 6))
        motion_bounds(link_poses(self.model, path), path, self.corners, self.longest_lever_mm, bounds)
        return bounds

    def rows_within(self, q_path: Floats, mm: float) -> Ints:
        """Rows of a path (m, 6), rad, its ends among them, at one of which no body is farther off than ``mm``.

        That holds for every state on the path, between its rows too, if no step from row to row is longer than twice
        that; where one is, both its ends are taken.
        """
        moved = np.concatenate([[0.0], np.cumsum(self.bounds_mm(q_path).max(axis=1))])
        kept, last = [0], len(moved) - 1
        for row in range(1, last):
            if moved[row + 1] - moved[kept[-1]] > 2.0 * mm:
                kept.append(row)
        return np.unique([*kept, last])

    def moving(self, q_path: Floats) -> tuple[Floats, Floats, Floats]:
        """A path's frames, and how far bodies and joints may have moved since its first state; ``q_path`` (m, 6), rad.

        Returns:
            T_base_link, shape (m, 7, 4, 4), mm; sums of :meth:`bounds_mm`, shape (m, 7), mm, the base's first; sums
            of each joint's turns, shape (m, 6), rad.
        """
        path = np.array(q_path, dtype=np.float64, order="C")
        frames, moved, rotated = np.empty((len(path), 7, 4, 4)), np.empty((len(path), 7)), np.empty((len(path), 6))
        _moving(self.model.lengths, path, self.corners, self.longest_lever_mm, frames, moved, rotated)
        return frames, moved, rotated


@nb.njit(cache=True)
def _moving(lengths, q, corners, lever, frames, moved, rotated):  # type: ignore[no-untyped-def]  # numba infers
    link_frames(lengths, q, frames)
    bounds = np.empty((len(q) - 1, 6))
    motion_bounds(frames, q, corners, lever, bounds)
    moved[0], rotated[0], moved[:, 0] = 0.0, 0.0, 0.0
    for k in range(len(q) - 1):
        for link in range(6):
            moved[k + 1, link + 1] = moved[k, link + 1] + bounds[k, link]
            rotated[k + 1, link] = rotated[k, link] + abs(q[k + 1, link] - q[k, link])


@allocation_free()
def motion_bounds(frames, q, corners, lever, bounds):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``bounds`` (m - 1, 6) from ``frames`` (m, 7, 4, 4), ``q`` (m, 6) and box ``corners`` (6, 8, 3).

    A NaN anywhere gives a NaN.
    """
    for k in range(len(q) - 1):
        rotated = 0.0
        for link in range(6):
            rotated += abs(q[k + 1, link] - q[k, link])
            here, there = frames[k, link + 1], frames[k + 1, link + 1]
            farthest = 0.0
            for c in range(8):
                squared = 0.0
                for i in range(3):
                    moved = there[i, 3] - here[i, 3]
                    for j in range(3):
                        moved += (there[i, j] - here[i, j]) * corners[link, c, j]
                    squared += moved * moved
                if not squared <= farthest:
                    farthest = squared
            bounds[k, link] = math.sqrt(farthest) + 2.0 * rotated * rotated * lever / 8.0
