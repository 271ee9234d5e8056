"""Distances of one needle axis from the few faces near it, for axes that are displaced again and again, in float64.

The arithmetic of a face is the engine's own (`axis_triangle`). Spheres around faces, and around blocks of 16 of them,
only say which faces need not be asked.
"""

from __future__ import annotations

import math

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.clearance.kernels.segment_triangle import axis_triangle

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


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def beyond(sphere, ox, oy, oz, ux, uy, uz, length, best):  # type: ignore[no-untyped-def]
    """Whether all that a sphere holds is at least ``best`` from the axis."""
    x, y, z = sphere[0] - ox, sphere[1] - oy, sphere[2] - oz
    s = min(max(x * ux + y * uy + z * uz, 0.0), length)
    x, y, z = x - s * ux, y - s * uy, z - s * uz
    limit = best + sphere[3]
    return x * x + y * y + z * z >= limit * limit


@nb.njit(cache=True, error_model="numpy")
def displaced_distance(triangles, faces, blocks, origin, outward, length, enough, hint):  # type: ignore[no-untyped-def]
    """Distance of an axis from faces, mm, and the row of the nearest; or of any face that is nearer than ``enough``.

    Args:
        triangles: Shape (m, 9), corners, mm.
        faces: Shape (m, 4), spheres around them.
        blocks: Shape (m / 16, 4), around each 16 of them.
        origin: Three numbers, where the axis starts, mm.
        outward: Three numbers, unit.
        length: Of the axis, mm.
        enough: The search ends at a face nearer than this, mm.
        hint: Row to begin with.
    """
    ox, oy, oz = origin
    ux, uy, uz = outward
    best, nearest = np.inf, hint
    if len(triangles) > 0:  # where the last axis was nearest, first
        best = _face(triangles, hint, ox, oy, oz, outward, length)
    for block in range(len(blocks)):
        if best < enough:
            break
        if beyond(blocks[block], ox, oy, oz, ux, uy, uz, length, best):
            continue
        for row in range(block * LANES, (block + 1) * LANES):
            if not beyond(faces[row], ox, oy, oz, ux, uy, uz, length, best):
                found = _face(triangles, row, ox, oy, oz, outward, length)
                if found < best:
                    best, nearest = found, row
    return best, nearest


@nb.njit(cache=True, error_model="numpy")
def _face(triangles, row, ox, oy, oz, outward, length):  # type: ignore[no-untyped-def]
    t = triangles[row]
    a, b, c = (t[0] - ox, t[1] - oy, t[2] - oz), (t[3] - ox, t[4] - oy, t[5] - oz), (t[6] - ox, t[7] - oy, t[8] - oz)
    return math.sqrt(axis_triangle(outward, length, a, b, c)[0])


@nb.njit(cache=True, error_model="numpy")
def displaced_distances(triangles, faces, blocks, origins, outward, length, distance):  # type: ignore[no-untyped-def]
    """Fill the distances (n,) of axes from ``origins`` (n, 3) along ``outward`` (n, 3)."""
    hint = 0
    for i in range(len(origins)):
        origin = (origins[i, 0], origins[i, 1], origins[i, 2])
        along = (outward[i, 0], outward[i, 1], outward[i, 2])
        distance[i], hint = displaced_distance(triangles, faces, blocks, origin, along, length, -1.0, hint)
