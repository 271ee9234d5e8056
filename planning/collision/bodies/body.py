"""One body of an arm as FCL objects that move with the joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import fcl
import numpy as np

from puncture_twin.planning.arm.links import LINK_NAMES
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.bodies.solid import Solid
from puncture_twin.planning.collision.loose_parts import half_spaces
from puncture_twin.planning.geometry.mesh import box_of

BODY_NAMES = (*LINK_NAMES, "tool", "holder", "needle")
"""The bodies of the arm, from the base on; not every arm has a tool."""

FLANGE_FRAME = 6
"""The frame of wrist 3, whose origin and axes are the flange's."""

NEVER_TESTED: Mapping[tuple[str, str], str] = MappingProxyType(
    {
        ("base", "shoulder"): "joined by a joint: they overlap at every angle",
        ("shoulder", "upper_arm"): "joined by a joint",
        ("upper_arm", "forearm"): "joined by a joint",
        ("forearm", "wrist_1"): "joined by a joint",
        ("wrist_1", "wrist_2"): "joined by a joint",
        ("wrist_2", "wrist_3"): "joined by a joint",
        ("wrist_3", "tool"): "bolted together",
        ("tool", "holder"): "bolted together",
        ("tool", "needle"): "bolted together",
        ("wrist_3", "holder"): "bolted together",
        ("wrist_3", "needle"): "bolted together",
        ("holder", "needle"): "bolted together",
    }
)
"""Pairs that touch by construction, with the reason; of an own arm's neighbours what is not joined is tested."""

NEVER_TOUCHING: Mapping[tuple[str, str], str] = MappingProxyType(
    {
        ("wrist_2", "holder"): "the holder begins at the flange, beyond wrist 2, and leads away from it at every angle",
        ("wrist_2", "needle"): "as the holder",
    }
)
"""Pairs that cannot touch where the arm ships with the program; wrist 2 of an own arm may carry a bracket."""


class Shape(NamedTuple):
    """A body for FCL: solid convex pieces, and one surface for the test against the skin."""

    solids: tuple[Solid, ...]
    surface: Solid
    hulls: tuple[Floats, ...]
    """For each solid, corners (n, 3), mm, of a convex hull that contains it, in the frame of the shapes."""


@dataclass(frozen=True, eq=False)
class Body:
    """One body of the arm.

    Attributes:
        name: One of ``BODY_NAMES``.
        frame: Index of its frame among ``link_poses``.
        T_frame_body: Shape (4, 4), mm: its shapes in that frame.
        bare: The body as it is.
        full: The body grown by the padding; ``bare`` itself where there is none.
        radius_mm: Every point of ``bare`` lies within this distance of the shapes' origin.
    """

    name: str
    frame: int
    T_frame_body: Floats
    bare: Shape
    full: Shape
    radius_mm: float

    @cached_property
    def box(self) -> Floats:
        """Shape (2, 3), mm: lowest and highest corner of a box about ``full``, in the frame of the shapes."""
        return box_of(np.concatenate(self.full.hulls))

    @property
    def hollow(self) -> bool:
        """Whether FCL sees no more than its surface against the skin."""
        return self.full.surface not in self.full.solids

    @cached_property
    def half_spaces(self) -> tuple[Floats, ...]:
        """Of each piece of ``full`` the half spaces whose intersection it is, (m, 4), in the frame of the shapes."""
        return tuple(half_spaces(corners) for corners in self.full.hulls)

    def pose(self, poses: Floats) -> fcl.Transform:
        """Where ``link_poses`` (7, 4, 4) has the body's shapes."""
        T = poses[self.frame] @ self.T_frame_body
        return fcl.Transform(T[:3, :3], T[:3, 3])

    def place(self, poses: Floats) -> None:
        """Move the shapes to where ``link_poses`` (7, 4, 4) has them."""
        transform = self.pose(poses)
        for shape in (self.bare,) if self.full is self.bare else (self.bare, self.full):
            for item in (*shape.solids, shape.surface):
                item.place(transform)
