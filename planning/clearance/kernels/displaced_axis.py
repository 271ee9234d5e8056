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
