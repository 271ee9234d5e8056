"""Whether a point lies inside a surface, by winding number or by rays, and where rays from a point cross it.

Rays decide where triangles are wound against their neighbours; an open surface has no answer (`Side.UNKNOWN`).

All rays of `crossings` start at one point, so a triangle is hit exactly by the rays inside the solid angle that it
subtends. Rays are binned by direction; each triangle visits the bins that its bounding cone touches, and of their rays
those inside of the cone: where a ray lies in the plane of a triangle far from it, the edge functions are rounding
alone. Corners are moved along the ray into a plane, each by its own numbers alone, so that triangles that share corners
share them there. On which side of an edge the ray passes is then decided rightly or as both: a ray through an edge or a
corner hits at least one of the triangles about it (Woop, Benthin and Wald, JCGT 2(1), 2013).
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.numba_kernels import allocation_free, nb
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import even_directions

RAYS, SEED = 5, 3
"""Random directions that vote, always the same: where one of them happens to hit an edge, the others do not."""


class Side(Enum):
    """Side of a surface on which a point lies."""

    INSIDE = "inside"
    OUTSIDE = "outside"
    UNKNOWN = "unknown"


def side_of(mesh: TriangleMesh, point: NDArray[np.float64]) -> Side:
    """Whether a point (3,) is in or out of a closed surface, whatever its orientation; unknown for an open one.

    Where triangles are given twice or wound against their neighbours, the winding number means nothing: it may be 0
    deep inside. Then a point is inside if rays from it cross the surface an odd number of times.
    """
    if not mesh.closed:
        return Side.UNKNOWN
    low, high = mesh.bounds
    if np.any(point < low) or np.any(point > high):
        return Side.OUTSIDE
    inside = round(winding_number(mesh, point)) != 0 if mesh.wound_alike else _leaves_oddly(mesh, point)
    return Side.INSIDE if inside else Side.OUTSIDE


def contains(mesh: TriangleMesh, point: NDArray[np.float64]) -> bool:
    """Whether a point (3,), mm, lies inside a closed surface, see :func:`side_of`; not if the surface is open.

    Most points lie outside of a surface's box: of these nobody needs to know whether it is closed.
    """
    low, high = mesh.bounds
    outside = bool(np.any(point < low) or np.any(point > high))
    return not outside and side_of(mesh, point) is Side.INSIDE


def inside_each(mesh: TriangleMesh, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of many points (n, 3) lie inside a closed surface, shape (n,); on it either way.

    Raises ValueError: The surface is open.
    """
    if not mesh.closed:
        raise ValueError("an open surface has no inside")
    if not mesh.wound_alike:
        return np.array([_leaves_oddly(mesh, point) for point in points], dtype=bool)
    low, high = mesh.bounds
    inside = np.all((points > low) & (points < high), axis=1)
    rows = np.flatnonzero(inside)
    inside[rows] = np.round(winding_numbers(mesh, points[rows])) != 0
    return inside


def _leaves_oddly(mesh: TriangleMesh, point: NDArray[np.float64]) -> bool:
    """Whether most of the rays from a point cross an odd number of the surface's distinct triangles."""
    a, b, c = np.moveaxis(mesh.triangles[mesh.distinct] - point, 1, 0)
    rays = np.random.default_rng(SEED).normal(size=(3, RAYS))
    weights = np.stack([np.cross(b, c) @ rays, np.cross(c, a) @ rays, np.cross(a, b) @ rays])  # edge functions
    ahead = (weights * np.stack([a @ rays, b @ rays, c @ rays])).sum(axis=0) * weights.sum(axis=0) > 0
    around = np.abs(np.sign(weights).sum(axis=0)) == len(weights)  # all of one sign: the line passes through
    odd = (around & ahead).sum(axis=0) % 2 == 1
    return bool(odd.mean() > 0.5)


SUM_RAYS = 1000
"""A fraction of all directions is found to about a percent."""


def winding_number(mesh: TriangleMesh, point: NDArray[np.float64]) -> float:
    """Winding number of a surface about a point: 0 outside a closed one, 1 or -1 (by orientation) inside.

    The sum of the triangles' signed solid angles over 4 pi; of an open surface any number between. With corners a, b, c
    seen from the point (Van Oosterom and Strackee, "The solid angle of a plane triangle", IEEE Trans. Biomed. Eng.
    30(2), 1983, Eq. 8):

        tan(angle / 2) = a.(b x c) / (|a||b||c| + (a.b)|c| + (b.c)|a| + (c.a)|b|)

    Args:
        mesh: The surface, mm.
        point: Shape (3,), mm, in the mesh's frame.
    """
    return float(winding_numbers(mesh, point[None])[0])


def winding_numbers(mesh: TriangleMesh, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """`winding_number` of many points (n, 3), mm: shape (n,)."""
    found = np.empty(len(points))
    _solid_angles(mesh.vertices, mesh.faces, np.array(points, dtype=np.float64, order="C"), found)
    return found / (4 * np.pi)


@nb.njit(cache=True, error_model="numpy")
def _solid_angles(vertices, faces, points, found):  # type: ignore[no-untyped-def]  # numba infers
    """Fill the sum of the signed solid angles of all triangles (m, 3) for each point, by the equation above."""
    for row in range(len(points)):
        x, y, z = points[row]
        total = 0.0
        for face in faces:
            a, b, c = vertices[face[0]], vertices[face[1]], vertices[face[2]]
            ax, ay, az = a[0] - x, a[1] - y, a[2] - z
            bx, by, bz = b[0] - x, b[1] - y, b[2] - z
            cx, cy, cz = c[0] - x, c[1] - y, c[2] - z
            na, nb_ = np.sqrt(ax * ax + ay * ay + az * az), np.sqrt(bx * bx + by * by + bz * bz)
            nc = np.sqrt(cx * cx + cy * cy + cz * cz)
            triple = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
            below = na * nb_ * nc + (ax * bx + ay * by + az * bz) * nc
            below += (bx * cx + by * cy + bz * cz) * na + (cx * ax + cy * ay + cz * az) * nb_
            total += 2.0 * np.arctan2(triple, below)  # below is negative where the angle exceeds pi
        found[row] = total


def odd_fraction(mesh: TriangleMesh, point: NDArray[np.float64]) -> float:
    """Fraction of all directions from a point (3,) in which a ray crosses the surface an odd number of times.

    0 outside of a closed surface, 1 inside, in between for an open one; a triangle that is given twice counts once.
    """
    surface = TriangleMesh(mesh.vertices, mesh.faces[mesh.distinct])
    return float(np.mean(crossings(surface, point, even_directions(SUM_RAYS)).count % 2))


def hit_fraction(mesh: TriangleMesh, point: NDArray[np.float64]) -> float:
    """Fraction of all directions from a point (3,) in which a ray hits the surface.

    1 inside a closed surface, and also in a hollow of it, of which `winding_number` is 0.
    """
    return float(np.mean(crossings(mesh, point, even_directions(SUM_RAYS)).count > 0))


MOST_POLAR_BINS, LEAST_POLAR_BINS = 120, 2
"""Bins over the polar angle (1.5 degrees each) for many rays; twice as many over the azimuth. For few rays: of fewer
bins a cone's window would hold some twice."""
SAME_CROSSING_MM, USUAL_CROSSINGS = 1e-6, 4
"""Crossings of one ray closer than this are one: the ray runs through an edge or a corner. Space is made for so many of
a ray before they are counted; for more, they are computed once again."""
CONE_SLACK, OUTSIDE = 1e-9, 1e-12
"""Radians by which a bounding cone is widened against rounding; and by so much less than the cone's is the cosine of a
ray that is outside of it whatever rounding did."""
ALL_AROUND = 1.5
"""Half-angle, rad, of a cone from which on all rays are visited: its window of bins would be nearly all of them."""
NARROW_SUM, NARROW_COSINE = 0.3, 0.2
"""A triangle has a narrow cone where the unit vectors to its corners add up to more than the first, and each is nearer
to their mean than the second: so the cone is narrower than a half-space, whatever rounding does."""
DOUBTFUL = 1e-12
"""A triangle seen so nearly edge-on that the part of its area across the ray is rounding: where on it the ray is
crossed is not known."""
NUDGE = 1e-7
"""Radians by which a ray through an edge or corner is rotated when its crossings are inconsistent."""


@dataclass(frozen=True, eq=False)
class Crossings:
    """Every crossing, sorted by ray and then by depth, mm from the origin; the first four of shape (c,)."""

    ray: Ints
    depth: Floats
    face: Ints  # shape (c,), triangle that is crossed
    sense: Ints
    """1 where the ray comes out through the triangle's front (its corners run counterclockwise seen from there), -1
    where it goes in, 0 where it does both at once (two surfaces touch there, or one is folded) or the triangle is
    seen edge-on."""
    count: Ints  # shape (n,), crossings of each ray
    first: Ints
    """Shape (n,), row in ``depth`` of each ray's first crossing (meaningless where count is 0)."""


def crossings(mesh: TriangleMesh, origin: Floats, directions: Floats, length: float = np.inf) -> Crossings:
    """All crossings of rays from one origin (3,), mm, along unit vectors (n, 3), with a surface, as far as a length."""
    order, starts, bins = _binned(directions)
    rays = np.take(directions, order, axis=0)
    lengths = np.sqrt(np.einsum("ij,ij->i", rays, rays))
    origin = np.array(origin, dtype=np.float64)
    space, total = -1, USUAL_CROSSINGS * len(directions)  # of no ray there are none
    while total > space:  # the arrays were too short: once more, as long as was counted
        space = total
        ray, depth, face = np.empty(space, np.int64), np.empty(space), np.empty(space, np.int64)
        sense = np.empty(space, np.int64)
        binned = rays, lengths, order, starts, bins
        total = _visit(mesh.vertices, mesh.faces, origin, binned, length, ray, depth, face, sense)
    ray, depth, face, sense = ray[:total], depth[:total], face[:total], sense[:total]
    rows = np.lexsort((depth, ray))  # by ray, then by depth
    ray, depth, face, sense = ray[rows], depth[rows], face[rows], sense[rows]
    fresh = np.ones(total, bool)  # false for the second of two triangles about an edge or corner that is hit
    fresh[1:] = (ray[1:] != ray[:-1]) | (depth[1:] - depth[:-1] > SAME_CROSSING_MM)
    sense = _merged_senses(sense, fresh)
    ray, depth, face = ray[fresh], depth[fresh], face[fresh]
    count = np.bincount(ray, minlength=len(directions))
    return Crossings(ray, depth, face, sense, count, np.cumsum(count) - count)


def _merged_senses(sense: Ints, fresh: Bools) -> Ints:
    """Sense of each merged crossing, 0 where those that it merges differ; ``fresh`` marks the first of each."""
    starts = np.flatnonzero(fresh)
    if len(starts) == 0:
        return sense
    most, least = np.maximum.reduceat(sense, starts), np.minimum.reduceat(sense, starts)
    return np.where(most == least, most, 0)


def first_crossing(mesh: TriangleMesh, origin: Floats, directions: Floats, length: float) -> Floats:
    """Depth of each ray's first crossing, shape (n,), mm; 0 for a ray that crosses nothing (it lies in the surface)."""
    found = crossings(mesh, origin, directions, length)
    depth = np.zeros(len(directions))
    hit = found.count > 0
    depth[hit] = found.depth[found.first[hit]]
    return depth


def _binned(directions: Floats) -> tuple[Ints, Ints, int]:
    """Ray numbers sorted by direction bin, where each bin starts, and how many there are over the polar angle.

    Shapes (n,) and (bins + 1,). There is about a ray a bin, as long as that gives no more than the most.
    """
    count = min(MOST_POLAR_BINS, max(LEAST_POLAR_BINS, math.isqrt(len(directions) // 2)))  # 2 count^2 bins
    polar = np.arccos(np.clip(directions[:, 2], -1, 1))
    azimuth = np.arctan2(directions[:, 1], directions[:, 0]) + np.pi
    row = np.minimum((polar * (count / np.pi)).astype(np.int64), count - 1)
    column = np.minimum((azimuth * (count / np.pi)).astype(np.int64), 2 * count - 1)
    bins = (row * 2 * count + column).astype(np.uint16)  # numpy sorts small numbers ten times as fast
    starts = np.zeros(2 * count**2 + 1, np.int64)
    np.cumsum(np.bincount(bins, minlength=2 * count**2), out=starts[1:])
    return np.argsort(bins, kind="stable"), starts, count


@allocation_free()
def _visit(vertices, faces, origin, binned, length, ray, depth, face, sense):  # type: ignore[no-untyped-def]  # numba infers
    """Count the crossings, and write them as far as the output arrays are long."""
    rays, lengths, order, starts, bins = binned
    found, per_radian, cap = 0, bins / np.pi, _cap(rays, lengths)
    for f in range(len(faces)):
        a, b, c = (
            _seen(vertices, faces[f, 0], origin),
            _seen(vertices, faces[f, 1], origin),
            _seen(vertices, faces[f, 2], origin),
        )
        if _beyond(a, b, c, length) or _off_cap(a, b, c, cap):
            continue
        center, radius = _cone(a, b, c)
        polar = np.arccos(min(1.0, max(-1.0, center[2])))
        # The window of bins that the triangle's cone touches: rows over the polar angle, columns over the azimuth.
        first_row = max(0, int((polar - radius) * per_radian))
        last_row = min(bins - 1, int((polar + radius) * per_radian))
        low, high = _azimuths(center, polar, radius, bins)
        if radius >= ALL_AROUND:  # all bins, each once: in one piece, since most of them hold no ray
            first_row, last_row, low, high = 0, 0, 0, 0
        least = -2.0 if radius >= ALL_AROUND else np.cos(radius) - OUTSIDE
        for row in range(first_row, last_row + 1):
            for column in range(low, high + 1):
                cell = row * 2 * bins + column % (2 * bins)
                begin, end = (0, len(order)) if radius >= ALL_AROUND else (starts[cell], starts[cell + 1])
                for k in range(begin, end):
                    inside = _along(center, rays[k]) >= least * lengths[k]
                    t, out = _cross(a, b, c, rays[k]) if inside else (-1.0, 0)
                    if 0.0 <= t <= length:
                        if found < len(ray):
                            ray[found], depth[found], face[found], sense[found] = order[k], t, f, out
                        found += 1
    return found


@allocation_free()
def _seen(vertices, row, origin):  # type: ignore[no-untyped-def]  # numba infers
    return vertices[row, 0] - origin[0], vertices[row, 1] - origin[1], vertices[row, 2] - origin[2]


@allocation_free()
def _beyond(a, b, c, length):  # type: ignore[no-untyped-def]  # numba infers
    """Whether no ray from the origin crosses a triangle at a length or less, by its corners' distances.

    No point is nearer than the first corner less the longer side from it; two points are no farther apart than twice
    that side, which is what rounding can do to the depth of a ray that grazes the triangle's plane.
    """
    to_b = _length(b[0] - a[0], b[1] - a[1], b[2] - a[2])
    to_c = _length(c[0] - a[0], c[1] - a[1], c[2] - a[2])
    return _length(a[0], a[1], a[2]) - 3.0 * max(to_b, to_c) > length + SAME_CROSSING_MM


@allocation_free()
def _off_cap(a, b, c, cap):  # type: ignore[no-untyped-def]  # numba infers
    """Whether no ray is inside of a triangle's cone, told without angles; False where that is not plain.

    Let s be the longer side from a corner a, and 4 s <= |a|: so the corners are seen within 2.03 s / |a| of each other,
    as is the cone's axis, and each ray in the cone within d = 4.1 s / |a| of a. All rays are within H of the cap's
    axis, so none is in the cone where cos(angle of a to it) < cos(H + d), of which

        cos(H + d) >= cos H (1 - d^2 / 2) - sin H d,    or cos H - sin H d where cos H < 0.

    The cone's own slack is below 2e-6.
    """
    axis, cosine, sine = cap
    to_b, to_c = (b[0] - a[0], b[1] - a[1], b[2] - a[2]), (c[0] - a[0], c[1] - a[1], c[2] - a[2])
    side2, distance2 = max(_along(to_b, to_b), _along(to_c, to_c)), _along(a, a)
    if 16.0 * side2 > distance2:
        return False
    distance, side = np.sqrt(distance2), np.sqrt(side2)
    least = cosine * distance if cosine < 0.0 else cosine * (distance - 8.5 * side2 / distance)
    return _along(a, axis) < least - sine * 4.1 * side - 3e-6 * distance


@allocation_free()
def _cap(rays, lengths):  # type: ignore[no-untyped-def]  # numba infers
    """A cone about all rays: its axis, cosine and sine of its half-angle; all directions where they have no middle."""
    x, y, z = 0.0, 0.0, 0.0
    for k in range(len(rays)):
        x, y, z = x + rays[k, 0], y + rays[k, 1], z + rays[k, 2]
    size, cosine = _length(x, y, z), 1.0
    if not size > 1e-6 * len(rays):
        return (0.0, 0.0, 1.0), -1.0, 0.0
    axis = x / size, y / size, z / size
    for k in range(len(rays)):
        cosine = min(cosine, _along(axis, rays[k]) / lengths[k])
    return axis, cosine, np.sqrt(max(0.0, 1.0 - cosine * cosine))


@allocation_free()
def _cone(a, b, c):  # type: ignore[no-untyped-def]  # numba infers
    """Axis and half-angle, rad, of a cone at the origin that holds a triangle; pi where no narrow cone does.

    A cone narrower than a half-space is convex: it holds the triangle where it holds its corners.
    """
    na, nb_, nc = _length(a[0], a[1], a[2]), _length(b[0], b[1], b[2]), _length(c[0], c[1], c[2])
    if min(na, nb_, nc) == 0.0:
        return (0.0, 0.0, 1.0), np.pi
    x = a[0] / na + b[0] / nb_ + c[0] / nc
    y = a[1] / na + b[1] / nb_ + c[1] / nc
    z = a[2] / na + b[2] / nb_ + c[2] / nc
    norm = _length(x, y, z)
    if norm < NARROW_SUM:
        return (0.0, 0.0, 1.0), np.pi
    x, y, z = x / norm, y / norm, z / norm
    to_a, to_b = (x * a[0] + y * a[1] + z * a[2]) / na, (x * b[0] + y * b[1] + z * b[2]) / nb_
    cosine = min(to_a, to_b, (x * c[0] + y * c[1] + z * c[2]) / nc)
    if cosine < NARROW_COSINE:
        return (0.0, 0.0, 1.0), np.pi
    return (x, y, z), np.arccos(min(1.0, cosine)) + CONE_SLACK + 1e-7


@allocation_free()
def _length(x, y, z):  # type: ignore[no-untyped-def]  # numba infers
    return np.sqrt(x * x + y * y + z * z)


@allocation_free()
def _azimuths(center, polar, radius, bins):  # type: ignore[no-untyped-def]  # numba infers
    """First and last azimuth bin that a cone touches (the last may run past the full circle).

    A circle of angular radius r about a point of polar angle p spans azimuths of +- asin(sin r / sin p), all at a pole.
    """
    if radius >= ALL_AROUND or polar - radius <= 0.0 or polar + radius >= np.pi:
        return 0, 2 * bins - 1
    half = np.arcsin(min(1.0, np.sin(radius) / np.sin(polar)))
    azimuth = np.arctan2(center[1], center[0]) + np.pi
    low = int(np.floor((azimuth - half) * (bins / np.pi) - 1e-9))
    high = int(np.floor((azimuth + half) * (bins / np.pi) + 1e-9))
    return low, high  # half is a right angle at most: no bin twice


@allocation_free()
def _cross(a, b, c, u):  # type: ignore[no-untyped-def]  # numba infers
    """Depth at which the ray from the origin along u crosses the triangle, -1 where it does not; and its sense."""
    p, q, r = _projected(a, u), _projected(b, u), _projected(c, u)
    wa, wb, wc = _edge_function(q, r), _edge_function(r, p), _edge_function(p, q)
    if not ((wa >= 0.0 and wb >= 0.0 and wc >= 0.0) or (wa <= 0.0 and wb <= 0.0 and wc <= 0.0)):
        return -1.0, 0
    total = wa + wb + wc
    if total == 0.0:
        return -1.0, 0
    depth = (wa * _along(a, u) + wb * _along(b, u) + wc * _along(c, u)) / total
    if abs(total) < DOUBTFUL * _largest(a, b, c) * max(_span(p), _span(q), _span(r)):
        return depth, 0
    return depth, 1 if total * _most(u) > 0.0 else -1


@allocation_free()
def _largest(a, b, c):  # type: ignore[no-untyped-def]  # numba infers
    return max(abs(a[0]), abs(a[1]), abs(a[2]), abs(b[0]), abs(b[1]), abs(b[2]), abs(c[0]), abs(c[1]), abs(c[2]))


@allocation_free()
def _span(p):  # type: ignore[no-untyped-def]  # numba infers
    """Distance of a point of the plane across a ray from it, along one axis or the other."""
    return max(abs(p[0]), abs(p[1]))


@allocation_free()
def _projected(p, u):  # type: ignore[no-untyped-def]  # numba infers
    """A point moved along the ray into the plane of the two axes that the ray follows least.

    It depends on the point alone, so triangles that share a corner share its projection.
    """
    if abs(u[2]) >= max(abs(u[0]), abs(u[1])):
        return p[0] - u[0] / u[2] * p[2], p[1] - u[1] / u[2] * p[2]
    if abs(u[1]) >= abs(u[0]):
        return p[2] - u[2] / u[1] * p[1], p[0] - u[0] / u[1] * p[1]
    return p[1] - u[1] / u[0] * p[0], p[2] - u[2] / u[0] * p[0]


@allocation_free()
def _most(u):  # type: ignore[no-untyped-def]  # numba infers
    """The component of a ray along the axis that it follows most: where it is negative, `_projected` mirrors."""
    if abs(u[2]) >= max(abs(u[0]), abs(u[1])):
        return u[2]
    return u[1] if abs(u[1]) >= abs(u[0]) else u[0]


@allocation_free()
def _edge_function(p, q):  # type: ignore[no-untyped-def]  # numba infers
    """On which side of the edge p-q the ray passes: the right sign or 0, for rounding keeps two products' order."""
    return p[0] * q[1] - p[1] * q[0]


@allocation_free()
def _along(p, u):  # type: ignore[no-untyped-def]  # numba infers
    return p[0] * u[0] + p[1] * u[1] + p[2] * u[2]


def consistent_crossings(mesh: TriangleMesh, origin: Floats, directions: Floats) -> tuple[Crossings, Bools]:
    """Crossings of rays from inside a closed surface, and for which rays, shape (n,), they are consistent.

    Such a ray has an odd number of crossings. Where triangles are wound alike it comes out and goes in alternately: if
    not, one shell lies within another, or two share a wall, and the first crossing need not be the exit.

    A ray through an edge or corner may count twice or touch without crossing; it is rotated by `NUDGE` and tried again.
    """
    found = crossings(mesh, origin, directions)
    consistent = _is_consistent(mesh, found)
    if mesh.closed and not consistent.all():
        rotated = directions.copy()
        rotated[~consistent] = _rotated(directions[~consistent])
        found = crossings(mesh, origin, rotated)
        consistent = _is_consistent(mesh, found)
    return found, consistent


def _is_consistent(mesh: TriangleMesh, found: Crossings) -> Bools:
    """Which rays have an odd number of crossings and, on a closed surface wound alike, alternate out and in."""
    odd = found.count % 2 == 1
    if not (mesh.closed and mesh.wound_alike):
        return odd
    wrong = found.sense == 0
    wrong[1:] |= (found.ray[1:] == found.ray[:-1]) & (found.sense[1:] == found.sense[:-1])
    return np.asarray(odd & (np.bincount(found.ray[wrong], minlength=len(odd)) == 0))


def _rotated(directions: Floats) -> Floats:
    helper = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    aside = np.cross(directions, helper)
    rotated = directions + NUDGE * aside / np.linalg.norm(aside, axis=1, keepdims=True)
    return np.asarray(rotated / np.linalg.norm(rotated, axis=1, keepdims=True))
