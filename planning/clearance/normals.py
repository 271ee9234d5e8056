"""From where needle axes are nearest to surfaces: unit vectors, from the triangles that a search has found."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.engine import AxisDistances
from puncture_twin.planning.geometry.triangle_distance import nearest_point


def normals_of(triangles: Sequence[Floats], target_ct: Floats, outward_ct: Floats, axes: AxisDistances) -> Floats:
    """Of n axes and k surfaces, shape (n, k, 3): unit, from the surface to the axis; NaN where they meet.

    Nothing is searched again. Where several points of a surface are equally near, it is any one of them.

    Args:
        triangles: Of the engine that measured: of each surface, shape (m, 9), corners in rows, mm.
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


@nb.njit(cache=True)
def axis_normals(triangles, nearest, distance, depth, target, outward, normal):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``normal`` (n, 3): unit, from the nearest point of each axis' nearest triangle to the axis; NaN on contact.

    Args:
        triangles: Shape (m, 9), corners in rows, mm.
        nearest: Shape (n,), row of each axis' nearest triangle.
        distance: Shape (n,), mm.
        depth: Shape (n,), of the nearest axis point, mm.
        target: Shape (3,), where the axes start.
        outward: Shape (n, 3), unit.
        normal: Filled.
    """
    for i in range(len(outward)):
        if distance[i] <= 0.0:
            normal[i] = math.nan
            continue
        x, y = target[0] + depth[i] * outward[i, 0], target[1] + depth[i] * outward[i, 1]
        z = target[2] + depth[i] * outward[i, 2]
        px, py, pz = nearest_point(triangles[nearest[i]].reshape(3, 3), x, y, z)
        dx, dy, dz = x - px, y - py, z - pz
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length == 0.0:
            normal[i] = math.nan
            continue
        normal[i, 0], normal[i, 1], normal[i, 2] = dx / length, dy / length, dz / length
