"""From where a needle axis is nearest to a surface: the unit vectors that first-order chances to touch are made of."""

from __future__ import annotations

import math

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.triangle_distance import nearest_point


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
