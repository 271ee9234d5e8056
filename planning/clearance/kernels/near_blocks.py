"""Which blocks of faces lie near a needle axis, and spheres around what they hold."""

from __future__ import annotations

import math

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.lanes import LANES

GROWN = 1 + 1e-9
"""Spheres are grown by more than the rounding of what made them."""


@nb.njit(cache=True, error_model="numpy")
def blocks_near(center, disc, count, origin, outward, length, reach):  # type: ignore[no-untyped-def]  # numba infers
    """Rows of the blocks that may lie within reach of an axis, and how near each may be.

    Args:
        center: Shape (nodes, 3), of `Blocks`, mm; the first are the blocks.
        disc: Shape (5, nodes), of `Blocks`.
        count: Blocks there are.
        origin: Shape (3,), where the axis starts, mm.
        outward: Shape (3,), unit.
        length: Of the axis, mm.
        reach: At its start and at its end, mm; linear in between.
    """
    found, bounds, kept = np.empty(count, np.int64), np.empty(count), 0
    start, slope = reach[0], (reach[1] - reach[0]) / max(length, 1e-9)
    tilt = math.sqrt(max(1.0 - slope * slope, 0.0))
    for block in range(count):
        x, y, z = center[block, 0] - origin[0], center[block, 1] - origin[1], center[block, 2] - origin[2]
        radius = math.hypot(disc[3, block], disc[4, block]) * (1 + 1e-6)
        along = x * outward[0] + y * outward[1] + z * outward[2]
        across = math.sqrt(max(x * x + y * y + z * z - along * along, 0.0))
        # least of |c - s u| - reach(s) over the axis, which is convex in s
        s = min(max(along + slope * across / max(tilt, 1e-3), 0.0), length)
        bound = math.hypot(across, along - s) - slope * s if tilt > 1e-3 else -abs(slope) * length
        if bound - radius <= start:
            found[kept], bounds[kept] = block, bound - radius
            kept += 1
    return found[:kept], bounds[:kept]


@nb.njit(cache=True, error_model="numpy")
def spheres_around(triangles, faces, blocks):  # type: ignore[no-untyped-def]
    """Fill spheres (m, 4) around faces (m, 9), and (m / 16, 4) around each 16 of them: centre and radius, mm."""
    for row in range(len(triangles)):
        t = triangles[row]
        _sphere(t.reshape(3, 3), faces[row])
    for block in range(len(blocks)):
        _sphere(triangles[block * LANES : (block + 1) * LANES].reshape(3 * LANES, 3), blocks[block])


@nb.njit(cache=True, error_model="numpy")
def _sphere(points, sphere):  # type: ignore[no-untyped-def]
    """About the middle of the points' box."""
    for x in range(3):
        low, high = points[0, x], points[0, x]
        for k in range(1, len(points)):
            low, high = min(low, points[k, x]), max(high, points[k, x])
        sphere[x] = 0.5 * (low + high)
    most = 0.0
    for k in range(len(points)):
        dx, dy, dz = points[k, 0] - sphere[0], points[k, 1] - sphere[1], points[k, 2] - sphere[2]
        most = max(most, dx * dx + dy * dy + dz * dz)
    sphere[3] = math.sqrt(most) * GROWN
