"""The patient as a field of signed distances, and the workcell's boxes: for quick tests of many arm poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from puncture_twin.planning.arm.tool import Box
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh

CELL_MM = 8.0
"""Between the field's nodes; where the skin is smooth the values between them are right to about 1 mm."""

SAMPLE_MM = 6.0
"""The skin's triangles are divided until no edge is longer: the distance to a corner exceeds that to the skin by
little where it matters, some mm away."""

MARGIN_CELLS = 4
"""Nodes around the skin's box; beyond them the distance to the box counts."""


@dataclass(frozen=True, eq=False)
class SkinField:
    """Signed distance to the skin on a regular grid: negative inside, where the skin has an inside.

    Attributes:
        origin: Shape (3,), mm, CT frame: the first node.
        values: Shape (i, j, k), mm; nodes stand ``CELL_MM`` apart.
    """

    origin: Floats
    values: Floats

    @classmethod
    def of(cls, skin: TriangleMesh) -> SkinField:
        """The field of a checked skin, CT frame."""
        import trimesh  # here: it costs a third of a second, and few need it

        points, faces = trimesh.remesh.subdivide_to_size(skin.vertices, skin.faces, SAMPLE_MM, max_iter=20)
        fine = trimesh.Trimesh(points, faces, process=False)
        low, high = skin.bounds
        origin = low - MARGIN_CELLS * CELL_MM
        counts = np.ceil((high - low) / CELL_MM).astype(int) + 2 * MARGIN_CELLS + 1
        nodes = origin + CELL_MM * np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1)
        distance, nearest = scipy.spatial.cKDTree(fine.vertices).query(nodes)
        # A node farther from the skin than half its cell's diagonal lies on one side with all its like neighbours.
        sides, _ = scipy.ndimage.label(distance > CELL_MM * np.sqrt(3.0) / 2.0)
        outside = sides == sides[0, 0, 0]
        inside = ~outside & (sides > 0)
        if inside.any():  # nearer nodes lie where the skin's normals say
            along = ((nodes - fine.vertices[nearest]) * fine.vertex_normals[nearest]).sum(axis=-1)
            outward = np.sign(along[outside].sum() - along[inside].sum())
            inside |= (sides == 0) & (outward * along < 0.0)
        return cls(origin, np.where(inside, -distance, distance))


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of one frame, as compiled code takes them.

    Attributes:
        T_box_frame: Shape (k, 4, 4), mm.
        halves: Shape (k, 3), half sizes, mm.
    """

    T_box_frame: Floats
    halves: Floats

    @classmethod
    def of(cls, boxes: Sequence[Box]) -> Boxes:
        """Of boxes whose ``T_base_box`` is their pose in that frame."""
        poses = [np.linalg.inv(box.T_base_box) for box in boxes]
        halves = [np.asarray(box.size_mm) / 2 for box in boxes]
        return cls(np.array(poses).reshape(-1, 4, 4), np.array(halves).reshape(-1, 3))
