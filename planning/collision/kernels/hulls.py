"""Compiled distance of two convex hulls, between two bounds that are each a proof: a plane, and two points.

A direction is searched by climbing from corner to corner; what it proves is then evaluated over all corners.

Source: Gilbert, Johnson and Keerthi 1988, "A fast procedure for computing the distance between complex objects in
three-dimensional space". The nearest point of a triangle: Ericson 2005, "Real-time collision detection", 5.1.5.
"""

# mypy: disable-error-code="no-untyped-def"
# numba infers the types

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.numba_kernels import allocation_free

TOUCHING = -1e9
"""In place of a gap: a point that both hulls contain was found."""
SUPPORTS = 30
"""Directions tried at most; it takes 3 to 8."""
TIGHT = 0.9
"""Bounds that are as near to one another as this are not worth another direction."""
ROUNDING_MM2 = 1e-16
"""Squared distance below which two points are one."""
FLAT = 1e-10
"""Volume of a tetrahedron over that of its edges' box below which it has no inside."""
FIRST, SECOND, THIRD = np.int64(0), np.int64(1), np.int64(2)
"""Of a simplex' corners; not plain numbers, see `numba_kernels`."""
ONWARD = 1.0 - 1e-9
"""A step that brings the nearest points no nearer than by this fraction is the last."""


class Hulls(NamedTuple):
    """Convex hulls, packed: h of them, with n corners in all, each in the frame that it moves with; mm."""

    axes: tuple[Floats, Floats, Floats]
    """The corners' x, y and z, each (n,) in one piece: so the outermost of many is found four abreast."""
    starts: Ints  # shape (h + 1,): where each hull's corners begin
    few: tuple[Floats, Floats, Floats]  # x, y and z of some outer corners of each hull, as in ``axes``
    few_starts: Ints
    slack: Floats  # shape (h,): no corner lies farther outside the hull of the few
    corners: Floats  # shape (n, 3): the corners once more
    inner: Floats  # shape (n, 3): corners within the body itself, where the hull only encloses it
    rounded: NDArray[np.bool_]  # shape (h,): where it does
    neighbour_starts: Ints  # shape (n + 1,): where each corner's neighbours begin
    neighbours: Ints  # their rows
    centres: Floats  # shape (h, 3): of a sphere about each hull
    radii: Floats
    frames: Ints  # shape (h,): the frame that each moves with


@allocation_free()
def _climb(corners, starts, ends, at, x, y, z):
    """Row of the corner farthest along a direction, by ever better neighbours from row ``at`` on."""
    best, better = x * corners[at, 0] + y * corners[at, 1] + z * corners[at, 2], True
    while better:
        better = False
        for row in range(starts[at], starts[at + 1]):
            other = ends[row]
            along = x * corners[other, 0] + y * corners[other, 1] + z * corners[other, 2]
            if along > best:
                best, at, better = along, other, True
    return at


@allocation_free()
def _nearest_of_segment(S, i, j):
    """The point of the segment of rows i and j of S that is nearest to the origin; which rows hold it, -1 for none."""
    ax, ay, az = S[i, 0], S[i, 1], S[i, 2]
    ux, uy, uz = S[j, 0] - ax, S[j, 1] - ay, S[j, 2] - az
    length = ux * ux + uy * uy + uz * uz
    fraction = -(ax * ux + ay * uy + az * uz)
    if fraction <= 0.0 or length <= ROUNDING_MM2:
        return i, -1, ax, ay, az
    if fraction >= length:
        return j, -1, S[j, 0], S[j, 1], S[j, 2]
    fraction /= length
    return i, j, ax + fraction * ux, ay + fraction * uy, az + fraction * uz


@allocation_free()
def _nearest_of_triangle(S, i, j, k):
    """The corner rows and the point of the triangle of three rows that is nearest to the origin."""
    ax, ay, az = S[i, 0], S[i, 1], S[i, 2]
    bx, by, bz = S[j, 0], S[j, 1], S[j, 2]
    cx, cy, cz = S[k, 0], S[k, 1], S[k, 2]
    abx, aby, abz, acx, acy, acz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    d1, d2 = -(abx * ax + aby * ay + abz * az), -(acx * ax + acy * ay + acz * az)
    d3, d4 = -(abx * bx + aby * by + abz * bz), -(acx * bx + acy * by + acz * bz)
    d5, d6 = -(abx * cx + aby * cy + abz * cz), -(acx * cx + acy * cy + acz * cz)
    u, v, w = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if u > 0.0 and v > 0.0 and w > 0.0:
        v, w = v / (u + v + w), w / (u + v + w)
        return i, j, k, ax + v * abx + w * acx, ay + v * aby + w * acy, az + v * abz + w * acz
    p, q, x, y, z = _nearest_of_segment(S, i, j)
    best = x * x + y * y + z * z
    for edge in range(2):
        m, n, ex, ey, ez = _nearest_of_segment(S, j if edge == 0 else i, k)
        squared = ex * ex + ey * ey + ez * ez
        if squared < best:
            best, p, q, x, y, z = squared, m, n, ex, ey, ez
    return p, q, -1, x, y, z


@allocation_free()
def _outside(S, p, q, r, opposite):
    """Whether the origin lies beyond the face p q r of a tetrahedron, or its inside cannot be decided."""
    ax, ay, az = S[p, 0], S[p, 1], S[p, 2]
    ux, uy, uz = S[q, 0] - ax, S[q, 1] - ay, S[q, 2] - az
    vx, vy, vz = S[r, 0] - ax, S[r, 1] - ay, S[r, 2] - az
    wx, wy, wz = S[opposite, 0] - ax, S[opposite, 1] - ay, S[opposite, 2] - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    height = nx * wx + ny * wy + nz * wz
    size = (ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz) * (wx * wx + wy * wy + wz * wz)
    return height * height <= FLAT * FLAT * size or -(nx * ax + ny * ay + nz * az) * height <= 0.0


@allocation_free()
def _nearest_of_tetrahedron(S):
    """The rows and the point of the tetrahedron of all four that is nearest; rows -1 where the origin lies inside."""
    best, i, j, k, x, y, z = math.inf, -1, -1, -1, 0.0, 0.0, 0.0
    for opposite in range(4):
        p, q, r = (opposite + 1) % 4, (opposite + 2) % 4, (opposite + 3) % 4
        if _outside(S, p, q, r, opposite):
            p, q, r, ex, ey, ez = _nearest_of_triangle(S, p, q, r)
            squared = ex * ex + ey * ey + ez * ez
            if squared < best:
                best, i, j, k, x, y, z = squared, p, q, r, ex, ey, ez
    return i, j, k, x, y, z


@allocation_free()
def _keep(S, i, j, k):
    """Move some rows, -1 for none, to the front; how many there are."""
    i0, i1, i2 = S[i, 0], S[i, 1], S[i, 2]
    j0, j1, j2 = S[j, 0], S[j, 1], S[j, 2]
    k0, k1, k2 = S[k, 0], S[k, 1], S[k, 2]
    S[0, 0], S[0, 1], S[0, 2] = i0, i1, i2
    S[1, 0], S[1, 1], S[1, 2] = j0, j1, j2
    S[2, 0], S[2, 1], S[2, 2] = k0, k1, k2
    return 1 + (j >= 0) + (k >= 0)


@allocation_free()
def distance_bounds(corners, starts, ends, M, axis, at, needed, S):
    """A lower and an upper bound on the distance of two convex hulls, mm; (``TOUCHING``, 0) where they overlap.

    The lower one is the gap between the hulls along a direction: a plane square to it lies between them. The upper
    one is the distance of a point of the one to a point of the other. The search ends when the lower bound exceeds
    what is needed, or when the upper one does not and both are near enough.

    Args:
        corners: Shape (n, 3), mm: of many hulls, each in its own frame.
        starts: Shape (n + 1,): where in ``ends`` each corner's neighbours begin.
        M: Shape (3, 4), mm: the second hull's frame in that of the first.
        axis: Shape (3,), unit, in the frame of the first, toward the second: where to begin; replaced by the direction
            of the lower bound.
        at: Shape (2,): a corner of either hull, where to begin; replaced by where it ended.
        needed: A gap above this will do, mm, 0 or more.
        S: Shape (4, 3): scratch. Where the hulls overlap, four differences of a point of the one and a point of the
            other; NaN in the last where there are fewer.
    """
    x, y, z = axis[0], axis[1], axis[2]
    lower, upper, count = -math.inf, math.inf, 0
    i, j = at[0], at[1]
    for _ in range(SUPPORTS):
        # Support: the first hull's corner farthest along the direction, less the second's farthest against it.
        bx = M[0, 0] * x + M[1, 0] * y + M[2, 0] * z
        by = M[0, 1] * x + M[1, 1] * y + M[2, 1] * z
        bz = M[0, 2] * x + M[1, 2] * y + M[2, 2] * z
        i, j = _climb(corners, starts, ends, i, x, y, z), _climb(corners, starts, ends, j, -bx, -by, -bz)
        qx, qy, qz = corners[j, 0], corners[j, 1], corners[j, 2]
        wx = corners[i, 0] - (M[0, 0] * qx + M[0, 1] * qy + M[0, 2] * qz + M[0, 3])
        wy = corners[i, 1] - (M[1, 0] * qx + M[1, 1] * qy + M[1, 2] * qz + M[1, 3])
        wz = corners[i, 2] - (M[2, 0] * qx + M[2, 1] * qy + M[2, 2] * qz + M[2, 3])
        gap = -(wx * x + wy * y + wz * z)  # a plane across the direction separates them by so much: a lower bound
        if gap > lower:
            lower, axis[0], axis[1], axis[2] = gap, x, y, z
        if lower > needed or (upper <= needed and lower >= TIGHT * upper):
            break
        # The simplex with the new point: its point v nearest to the origin gives the upper bound |v|.
        S[count, 0], S[count, 1], S[count, 2] = wx, wy, wz
        p, q, r, vx, vy, vz = count, -1, -1, wx, wy, wz
        if count == 1:
            p, q, vx, vy, vz = _nearest_of_segment(S, FIRST, SECOND)
        elif count == 2:
            p, q, r, vx, vy, vz = _nearest_of_triangle(S, FIRST, SECOND, THIRD)
        elif count == 3:
            p, q, r, vx, vy, vz = _nearest_of_tetrahedron(S)
        before, squared = upper, vx * vx + vy * vy + vz * vz
        if p < 0 or squared <= ROUNDING_MM2:  # the origin is in the simplex: the hulls share a point
            lower, upper = TOUCHING, 0.0
            if count < 3:
                S[3, 0] = math.nan
            break
        upper = math.sqrt(squared)
        if upper >= before * ONWARD:  # no progress but rounding
            upper = before
            break
        count = _keep(S, p, q, r)  # the corners that v does not depend on are dropped
        x, y, z = -vx / upper, -vy / upper, -vz / upper
    at[0], at[1] = i, j
    return lower, upper


@allocation_free()
def deep(S, mm):
    """Whether the origin lies within the tetrahedron of all four rows, farther than ``mm`` from each face; not if NaN.

    Of differences of points of two convex bodies: then the bodies share a point, and one has to move by more to part.
    """
    for opposite in range(4):
        p, q, r = (opposite + 1) % 4, (opposite + 2) % 4, (opposite + 3) % 4
        ax, ay, az = S[p, 0], S[p, 1], S[p, 2]
        ux, uy, uz = S[q, 0] - ax, S[q, 1] - ay, S[q, 2] - az
        vx, vy, vz = S[r, 0] - ax, S[r, 1] - ay, S[r, 2] - az
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        height = nx * (S[opposite, 0] - ax) + ny * (S[opposite, 1] - ay) + nz * (S[opposite, 2] - az)
        origin, size = -(nx * ax + ny * ay + nz * az), math.sqrt(nx * nx + ny * ny + nz * nz)
        if not (origin if height > 0.0 else -origin) > mm * size:
            return False
    return True


@allocation_free(fastmath={"nnan", "ninf", "nsz", "reassoc", "contract"})
def _extreme(px, py, pz, x, y, z):
    """The largest projection of points on a direction; they are finite, so fastmath may take four at a time."""
    best = -1e300
    for i in range(len(px)):
        best = max(best, x * px[i] + y * py[i] + z * pz[i])
    return best


@allocation_free()
def _plane_gap(axes, starts, first, second, M, x, y, z):
    """Gap between two hulls projected on a direction, over all their corners, mm."""
    cx, cy, cz = axes
    bx = M[0, 0] * x + M[1, 0] * y + M[2, 0] * z
    by = M[0, 1] * x + M[1, 1] * y + M[2, 1] * z
    bz = M[0, 2] * x + M[1, 2] * y + M[2, 2] * z
    begin, end = starts[second], starts[second + 1]
    gap = x * M[0, 3] + y * M[1, 3] + z * M[2, 3]
    gap -= _extreme(cx[begin:end], cy[begin:end], cz[begin:end], -bx, -by, -bz)
    begin, end = starts[first], starts[first + 1]
    return gap - _extreme(cx[begin:end], cy[begin:end], cz[begin:end], x, y, z)


@allocation_free()
def _toward(hulls, first, second, M, axis):
    """Fill ``axis`` with the unit direction from one hull's sphere to the other's."""
    squared = 0.0
    for i in range(3):
        axis[i] = M[i, 3] - hulls.centres[first, i]
        for k in range(3):
            axis[i] += M[i, k] * hulls.centres[second, k]
        squared += axis[i] ** 2
    size = math.sqrt(squared)
    for i in range(3):
        axis[i] = axis[i] / size if size > 0.0 else (1.0 if i == 2 else 0.0)


@allocation_free()
def _inner_bound(hulls, M, axis, at, S):
    """The lower bound between the bodies within two hulls; ``axis`` and ``at`` stay as the hulls' search left them."""
    x, y, z, i, j = axis[0], axis[1], axis[2], at[0], at[1]
    starts, ends = hulls.neighbour_starts, hulls.neighbours
    lower, _ = distance_bounds(hulls.inner, starts, ends, M, axis, at, 0.0, S)
    axis[0], axis[1], axis[2], at[0], at[1] = x, y, z, i, j
    return lower


@allocation_free(forceinline=True)
def hull_gap(hulls, first, second, M, axis, at, needed, S):
    """Lower bound on the distance of two hulls, mm; ``TOUCHING`` where the bodies in them surely share a point.

    Where it is not above ``needed`` it is at least near to the distance; 0 where nothing is known.

    Args:
        axis: See :func:`distance_bounds`; zero begins the search anew.
    """
    if axis[0] == 0.0 and axis[1] == 0.0 and axis[2] == 0.0:
        at[0], at[1] = hulls.starts[first], hulls.starts[second]
        _toward(hulls, first, second, M, axis)
    starts, ends = hulls.neighbour_starts, hulls.neighbours
    lower, _ = distance_bounds(hulls.corners, starts, ends, M, axis, at, needed, S)
    if lower > 0.0:
        x, y, z = axis[0], axis[1], axis[2]
        # Climbing over neighbours may end at a corner that rounding favours: all corners confirm the gap, first those
        # of a coarser hull around each (looser by `slack`), which are fewer.
        gap = _plane_gap(hulls.few, hulls.few_starts, first, second, M, x, y, z)
        gap -= hulls.slack[first] + hulls.slack[second]
        if gap <= 0.0 or gap <= needed < lower:  # else all corners prove no more that is of use
            gap = max(gap, _plane_gap(hulls.axes, hulls.starts, first, second, M, x, y, z))
        return max(0.0, gap)
    if lower == TOUCHING and (hulls.rounded[first] or hulls.rounded[second]):
        lower = _inner_bound(hulls, M, axis, at, S)
    return TOUCHING if lower == TOUCHING else 0.0
