"""Needle holder and needle on the flange, and the boxes of the workcell."""

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path

import numpy as np

from puncture_twin.planning.arm.links import convex_pieces
from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply

SLABS = 6
"""Into how many slabs along its longest side a tool is cut before the hulls are taken: what is bent stays bent."""


@dataclass(frozen=True, eq=False)
class ToolBody:
    """A rigid body that is bolted to the flange."""

    mesh: TriangleMesh  # its surface, mm, in the flange's frame
    file: Path
    unit_mm: float  # how many millimetres one unit of the file is
    T_flange_file: Floats  # shape (4, 4), mm: the file's frame in the flange's
    key: str

    @cached_property
    def pieces(self) -> tuple[TriangleMesh, ...]:
        """Convex pieces that together contain it, open or turned inside out. Raises InputError: It is flat."""
        pieces = convex_pieces(self.mesh, SLABS)
        if not pieces:
            refuse("the mesh is flat", self.key, "a body, not a sheet", "flat_mesh")
        return pieces

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ToolBody) and self.mesh.digest == other.mesh.digest

    def __hash__(self) -> int:
        return hash(self.mesh.digest)


HOLDER_ROOT_MM = 5.0
"""How far the holder's body reaches back into wrist 3, whose mesh ends up to 1.4 mm before the flange plane: without
an overlap a flat surface could pass between the two unseen."""
NEEDLE_ROOT_MM = 1.0
"""How far the needle's body reaches back into the holder, for the same reason."""


@dataclass(frozen=True)
class Tool:
    """Needle and holder. The holder is a cylinder from the flange along +z; the needle goes on from it to the tip."""

    needle_length_mm: float
    shaft_mm: float  # usable length: from the holder's end to the tip
    needle_diameter_mm: float
    holder_diameter_mm: float
    body: ToolBody | None = None  # what the flange carries besides them, or None

    @property
    def holder_length_mm(self) -> float:
        """Distance from the flange to where the needle leaves the holder, mm."""
        return self.needle_length_mm - self.shaft_mm

    @property
    def holder_span_mm(self) -> tuple[float, float]:
        """Start and end of the holder's body on the flange's z axis, mm."""
        return (-HOLDER_ROOT_MM, self.holder_length_mm)

    @property
    def needle_span_mm(self) -> tuple[float, float]:
        """Start and end of the needle's body on the flange's z axis, mm."""
        return (self.holder_length_mm - NEEDLE_ROOT_MM, self.needle_length_mm)


@dataclass(frozen=True, eq=False)
class Box:
    """A solid cuboid in the workcell, such as the table."""

    name: str
    T_base_box: Floats  # shape (4, 4), mm: the box's centre and axes in the base frame
    size_mm: tuple[float, float, float]  # full edge lengths along its axes

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_base_box", read_only(self.T_base_box))

    @property
    def corners(self) -> Floats:
        """The eight corners of the box, base frame, shape (8, 3), mm."""
        local = np.array(list(product((-0.5, 0.5), repeat=3))) * self.size_mm
        return np.asarray(apply(self.T_base_box, local))

    @property
    def bounds(self) -> Floats:
        """Lowest and highest corner of the axis-aligned box about it, base frame, shape (2, 3), mm."""
        half = np.abs(self.T_base_box[:3, :3]) @ (np.asarray(self.size_mm) / 2.0)
        return np.stack([self.T_base_box[:3, 3] - half, self.T_base_box[:3, 3] + half])


SIDES = 24
"""Sides of the polygon of the bore: inscribed, so the bore is up to 0.9 % narrower than it is (3 mm of 350)."""


def gantry_boxes(T_base_gantry: Floats, *, bore_diameter_mm: float, wall_mm: float, depth_mm: float) -> tuple[Box, ...]:
    """Boxes of a gantry: the wall about its bore.

    Args:
        T_base_gantry: Shape (4, 4), mm: the bore's centre; its axis is z, so a tilt is a turn about x.
        wall_mm: How far the wall reaches outward from the bore; the housing beyond does not count.

    Returns:
        Boxes named ``gantry_0`` ...: every point of the wall is in one of them, and every point nearer to the axis than
        cos(pi / ``SIDES``) times the bore's radius in none.
    """
    radius = bore_diameter_mm / 2.0
    inner, outer = radius * np.cos(np.pi / SIDES), radius + wall_mm
    size = (outer - inner, 2.0 * outer * np.tan(np.pi / SIDES), depth_mm)
    boxes = []
    for side in range(SIDES):
        turn = 2.0 * np.pi * side / SIDES
        T = np.eye(4)
        T[:2, 0], T[:2, 1] = (np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))
        T[:2, 3] = (inner + outer) / 2.0 * T[:2, 0]
        boxes.append(Box(f"gantry_{side}", np.asarray(T_base_gantry, dtype=np.float64) @ T, size))
    return tuple(boxes)
