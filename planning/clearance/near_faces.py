"""The faces of a structure near one needle axis: all that a small displacement of the needle can meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.clearance.kernels.blocks import Blocks
from puncture_twin.planning.clearance.kernels.displaced_axis import displaced_distances
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.clearance.kernels.near_blocks import blocks_near, spheres_around


@dataclass(frozen=True, eq=False)
class NearFaces:
    """Faces of one structure, and spheres around them; CT frame, mm.

    Attributes:
        triangles: Shape (m, 9), corners, in blocks of 16, those that may be nearest first.
        faces: Shape (m, 4), a sphere around each: centre, radius.
        blocks: Shape (m / 16, 4), around each 16.
    """

    triangles: Floats
    faces: Floats
    blocks: Floats

    def __len__(self) -> int:
        return len(self.triangles)

    def distance(self, origins_ct: Floats, outward_ct: Floats, length: float) -> Floats:
        """Of axes from ``origins_ct`` (n, 3) along ``outward_ct`` (n, 3) from these faces, shape (n,), mm."""
        found = np.empty(len(origins_ct))
        origins, outward = (np.ascontiguousarray(rows, dtype=np.float64) for rows in (origins_ct, outward_ct))
        displaced_distances(self.triangles, self.faces, self.blocks, origins, outward, float(length), found)
        return found


def near_faces(
    blocks: Blocks, origin_ct: Floats, outward_ct: Floats, length: float, reach: tuple[float, float]
) -> NearFaces:
    """All faces within reach of an axis, and some beyond.

    Args:
        blocks: The packed surface.
        origin_ct: Shape (3,), where the axis starts.
        outward_ct: Shape (3,), unit.
        length: Of the axis, mm.
        reach: At its start and at its end, mm; linear in between.
    """
    rows, bounds = blocks_near(blocks.center, blocks.disc, len(blocks.local), origin_ct, outward_ct, length, reach)
    order = rows[np.argsort(bounds, kind="stable")]
    triangles = blocks.triangles[(order[:, None] * LANES + np.arange(LANES)).ravel()]
    faces, groups = np.empty((len(triangles), 4)), np.empty((len(order), 4))
    spheres_around(triangles, faces, groups)
    return NearFaces(triangles, faces, groups)
