"""Distance of points from triangles, in float64, triangles without area included.

The engines' searches have kernels of their own, which measure many needles against one triangle; everything else that
asks how far a point is from a surface asks here.
"""

import math

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.numba_kernels import allocation_free

ROUNDS_TO_ZERO = 1e-30
"""Squared lengths, mm^2, below which a segment has no direction."""


def squared_distance(points: NDArray[np.float64], triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared distance, mm^2, from points (..., 3) to triangles (..., 3, 3), broadcast against each other."""
    shape = np.broadcast_shapes(points.shape[:-1], triangles.shape[:-2])
    flat_points = np.broadcast_to(points, (*shape, 3)).reshape(-1, 3)
    flat_triangles = np.broadcast_to(triangles, (*shape, 3, 3)).reshape(-1, 3, 3)
    squares = np.empty(len(flat_points))
    _each(np.ascontiguousarray(flat_triangles), np.ascontiguousarray(flat_points), squares)
    return squares.reshape(shape)


@allocation_free()
def _each(triangles, points, squares):  # type: ignore[no-untyped-def]  # numba infers
    """Squared distance of each point from its triangle, row by row."""
    for row in range(len(points)):
        squares[row] = to_triangle(triangles[row], points[row, 0], points[row, 1], points[row, 2])


@allocation_free()
def to_triangle(t, x, y, z):  # type: ignore[no-untyped-def]  # numba infers
    """Squared distance of a point to a triangle (3, 3): its edges', or its plane's where the foot lies inside.

    The edges always count, so that a triangle without area, whose normal means nothing, is not lost.
    """
    ax, ay, az = t[0, 0] - x, t[0, 1] - y, t[0, 2] - z
    bx, by, bz = t[1, 0] - x, t[1, 1] - y, t[1, 2] - z
    cx, cy, cz = t[2, 0] - x, t[2, 1] - y, t[2, 2] - z
    squared = min(
        _to_segment(ax, ay, az, bx, by, bz), _to_segment(bx, by, bz, cx, cy, cz), _to_segment(cx, cy, cz, ax, ay, az)
    )
    # b x c, c x a, a x b seen from the point; their sum is the normal, and each part's sign along it the side.
    px, py, pz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    qx, qy, qz = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    rx, ry, rz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    nx, ny, nz = px + qx + rx, py + qy + ry, pz + qz + rz
    area = nx * nx + ny * ny + nz * nz
    inside = (
        px * nx + py * ny + pz * nz >= 0.0 and qx * nx + qy * ny + qz * nz >= 0.0 and rx * nx + ry * ny + rz * nz >= 0.0
    )
    if inside and area > ROUNDS_TO_ZERO:
        height = ax * nx + ay * ny + az * nz
        squared = min(squared, height * height / area)
    return squared


@allocation_free()
def _to_segment(ax, ay, az, bx, by, bz):  # type: ignore[no-untyped-def]  # numba infers
    ux, uy, uz = bx - ax, by - ay, bz - az
    squared = ux * ux + uy * uy + uz * uz
    fraction = 0.0
    if squared > ROUNDS_TO_ZERO:
        fraction = min(1.0, max(0.0, -(ax * ux + ay * uy + az * uz) / squared))
    x, y, z = ax + fraction * ux, ay + fraction * uy, az + fraction * uz
    return x * x + y * y + z * z


@allocation_free()
def nearest_point(t, x, y, z):  # type: ignore[no-untyped-def]  # numba infers
    """The point of a triangle (3, 3) that is nearest to another, as three numbers; one without area included."""
    best, px, py, pz = math.inf, 0.0, 0.0, 0.0
    for i in range(3):
        j = (i + 1) % 3
        ux, uy, uz = t[j, 0] - t[i, 0], t[j, 1] - t[i, 1], t[j, 2] - t[i, 2]
        ax, ay, az = t[i, 0] - x, t[i, 1] - y, t[i, 2] - z
        squared, along = ux * ux + uy * uy + uz * uz, 0.0
        if squared > ROUNDS_TO_ZERO:
            along = min(1.0, max(0.0, -(ax * ux + ay * uy + az * uz) / squared))
        qx, qy, qz = ax + along * ux, ay + along * uy, az + along * uz
        distance = qx * qx + qy * qy + qz * qz
        if distance < best:
            best, px, py, pz = distance, x + qx, y + qy, z + qz
    ax, ay, az = t[0, 0] - x, t[0, 1] - y, t[0, 2] - z
    bx, by, bz = t[1, 0] - x, t[1, 1] - y, t[1, 2] - z
    cx, cy, cz = t[2, 0] - x, t[2, 1] - y, t[2, 2] - z
    # The foot on its plane, where it lies inside: as in `to_triangle`.
    ux, uy, uz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    vx, vy, vz = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    wx, wy, wz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    nx, ny, nz = ux + vx + wx, uy + vy + wy, uz + vz + wz
    area = nx * nx + ny * ny + nz * nz
    within = ux * nx + uy * ny + uz * nz, vx * nx + vy * ny + vz * nz, wx * nx + wy * ny + wz * nz
    if min(within) >= 0.0 and area > ROUNDS_TO_ZERO:
        height = (ax * nx + ay * ny + az * nz) / area
        if height * height * area < best:
            px, py, pz = x + height * nx, y + height * ny, z + height * nz
    return px, py, pz


@allocation_free()
def farthest_from(triangles, points):  # type: ignore[no-untyped-def]  # numba infers
    """The largest distance of points (n, 3) to triangles (m, 3, 3); 0 without points."""
    farthest = 0.0
    for i in range(len(points)):
        nearest = math.inf
        for k in range(len(triangles)):
            nearest = min(nearest, to_triangle(triangles[k], points[i, 0], points[i, 1], points[i, 2]))
        farthest = max(farthest, nearest)
    return math.sqrt(farthest)


@allocation_free()
def lower_squares(triangles, places, starts, order, points, squares):  # type: ignore[no-untyped-def]  # numba infers
    """Lower squared distances (n,) of points (n, 3) to those from the triangles (m, 3, 3) at their place.

    A triangle is at three places (m, 3); the points of place k are ``order[starts[k] : starts[k + 1]]``.
    """
    for k in range(len(triangles)):
        for corner in range(3):
            place = places[k, corner]
            for row in range(starts[place], starts[place + 1]):
                i = order[row]
                square = to_triangle(triangles[k], points[i, 0], points[i, 1], points[i, 2])
                squares[i] = min(squares[i], square)
