"""The target's own distance from a packed surface: the upper bound of every needle axis that starts there."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.clearance.kernels.segment_triangle import axis_triangle

STACK = 512
"""Groups of nodes that wait: at most 16 for each of a tree's levels, and 2^31 triangles have 8 levels."""


@nb.njit(cache=True, error_model="numpy")
def nearest_triangle(triangles, nodes, base, target, slack):  # type: ignore[no-untyped-def]  # numba infers
    """Distance of the target from a surface, mm, and the row of the nearest triangle.

    Args:
        triangles: See `Blocks`.
        nodes: See `bounds.disc_bounds`, made for this target.
        base: See `Blocks`.
        target: Shape (3,), mm.
        slack: Rounding of a node's coordinate, mm.
    """
    nearest, distance, waiting = 0, _distance(triangles, np.int64(0), target), 1
    stack = np.empty((STACK, 2), np.int64)
    stack[0, 0], stack[0, 1] = base[-1], len(base) - 1
    while waiting > 0:
        waiting -= 1
        first, level = stack[waiting, 0], stack[waiting, 1]
        for k in range(LANES):
            reach = nodes[first, 9, k] - 2 * nodes[first, 8, k]
            if reach - slack - 1e-5 * abs(reach) >= distance:
                continue
            child = (first - base[level]) * LANES + k
            if level > 0:
                stack[waiting, 0], stack[waiting, 1] = base[level - 1] + child, level - 1
                waiting += 1
                continue
            for row in range(child * LANES, (child + 1) * LANES):
                found = _distance(triangles, row, target)
                nearest, distance = row if found < distance else nearest, min(found, distance)
    return distance, nearest


@nb.njit(cache=True, error_model="numpy")
def _distance(triangles, row, target):  # type: ignore[no-untyped-def]  # numba infers
    """Of a point from one triangle: an axis of length 0, mm."""
    t, (x, y, z) = triangles[row], (target[0], target[1], target[2])
    a, b, c = (t[0] - x, t[1] - y, t[2] - z), (t[3] - x, t[4] - y, t[5] - z), (t[6] - x, t[7] - y, t[8] - z)
    return np.sqrt(axis_triangle((0.0, 0.0, 1.0), 0.0, a, b, c)[0])
