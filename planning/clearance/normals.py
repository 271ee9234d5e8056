"""From where needle axes are nearest to surfaces: unit vectors, from the triangles that a search has found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.clearance.engine import AxisDistances
from puncture_twin.planning.clearance.kernels.axis_normals import axis_normals


def normals_of(triangles: Sequence[Floats], target_ct: Floats, outward_ct: Floats, axes: AxisDistances) -> Floats:
    """Of n axes and k surfaces, shape (n, k, 3): unit, from the surface to the axis; NaN where they meet.

    Args:
        triangles: Of each surface, shape (m, 9), corners in rows, mm.
        target_ct: Shape (3,), where the axes start.
        outward_ct: Shape (n, 3), unit.
        axes: Measured from there, their ``nearest`` rows of ``triangles``.
    """
    target, outward = (np.array(given, dtype=np.float64, order="C") for given in (target_ct, outward_ct))
    normal = np.empty((len(triangles), len(outward), 3))
    for row, corners in enumerate(triangles):
        nearest, distance, depth = (np.array(of[:, row]) for of in (axes.nearest, axes.distance, axes.depth))
        axis_normals(corners, nearest, distance, depth, target, outward, normal[row])
    return normal.transpose(1, 0, 2)
