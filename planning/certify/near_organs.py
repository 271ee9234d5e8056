"""Cells of directions against organs: proofs that they are clear, or too near, by planes and by convexity.

docs/concepts/certificate.md, lemmas 2 to 4. No distance is needed to prove a cell clear: a plane that keeps a triangle
at the limit from every axis of the cell is proof enough, however it was found.
"""

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.certify.cells import Cones, Lists, Zones
from puncture_twin.planning.clearance.kernels.segment_triangle import axis_triangle

BULGES = 3.0
"""Times L and the bulge: what a witness must lack so that directions outside the hull of the corners are covered."""
SURELY_MIXED = np.radians(0.5)
"""A cell with a smaller radius of which the inherited witness rejects some corners, not all, is split unmeasured:
it is not safe, and at such a size another triangle rejects all of it in one case of a hundred."""
HOPELESS = 0.6
"""At a corner of a cell the axis is farther from a triangle next to it by about this part of the cone's radius at
least: a triangle that is no witness by this estimate is not tried."""


@dataclass(frozen=True, eq=False)
class Organs:
    """The m triangles of k structures that demand a margin, from the target."""

    corners: Floats  # shape (m, 9), mm
    group: Ints  # shape (m,), the structure of each, 0 to k - 1
    limits: Floats  # shape (k,), needle radius plus margin, mm
    zones: Zones


@dataclass(frozen=True, eq=False)
class OrganFacts:
    """Facts about organs that hold for every axis of n cells."""

    near: Lists
    """The triangles of which a cell is not proven clear; a cell without one is clear of all."""
    witness: Ints
    """Shape (n,), a triangle, -1 for none. In a rejected cell every axis comes too near to it."""
    rejected: Bools  # shape (n,), every axis comes too near to a structure
    largest: Floats  # shape (n,), in a rejected cell every axis comes at least so near to the witness, mm
    measured: int
    """Cells for which a triangle was measured that their parents' witness had not settled."""


def organ_facts(
    organs: Organs, lists: Lists, parent: Ints, witness: Ints, cones: Cones, lengths: Floats, *, wide: float, pad: float
) -> OrganFacts:
    """Evaluate n cells against the triangles that matter to their parents, by rows (n,).

    ``witness`` (n,) is the triangle that nearly rejected each parent, or -1; axes are checked as far as ``lengths`` (n,
    2), at least and at most, mm; cells wider than ``wide``, rad, are only narrowed; ``pad``, mm, is kept from every
    limit.
    """
    n = len(parent)
    found, rejected, largest = np.full(n, -1), np.zeros(n, bool), np.full(n, np.nan)
    zone = organs.zones.axis, organs.zones.cosine, organs.zones.sine, organs.zones.nearest
    shape = cones.centres, cones.corners, cones.radius, cones.bulge
    start, items, measured = _checked(
        organs.corners, organs.group, organs.limits, zone, lengths, lists.start, lists.items, parent, witness,
        shape, wide, pad, (found, rejected, largest),
    )  # fmt: skip
    return OrganFacts(Lists(start, items), found, rejected, largest, measured)


@nb.njit(cache=True)
def _checked(  # type: ignore[no-untyped-def]  # numba infers
    corners, group, limits, zone, lengths, start, items, parent, witness, shape, wide, pad, out
):
    centres, ends, radius, bulge = shape
    found, rejected, largest = out
    out_start, kept = np.zeros(len(parent) + 1, np.int64), np.empty(max(1024, len(items)), np.int64)
    measured = 0
    for i in range(len(parent)):
        u, four, narrow = (centres[i, 0], centres[i, 1], centres[i, 2]), ends[i], radius[i] <= wide
        candidates = items[start[parent[i]] : start[parent[i] + 1]]
        filled = out_start[i]
        out_start[i + 1] = filled
        if filled + len(candidates) > len(kept):
            kept = _grown(kept, filled, 2 * (filled + len(candidates)))
        if narrow and witness[i] >= 0:
            t = witness[i]
            hit, worst = _corners(corners[t], four, lengths[i, 0], limits[group[t]] - pad, bulge[i])
            if hit == 4:
                rejected[i], largest[i], found[i] = True, worst, t
                continue
            if hit > 0 and radius[i] <= SURELY_MIXED:
                narrow = False
                found[i] = t
        organs, cell = (corners, group, limits), (u, four, radius[i], bulge[i], (lengths[i, 0], lengths[i, 1]))
        count, t, looked, reject, worst = _near(organs, zone, candidates, cell, narrow, pad, kept[filled:])
        out_start[i + 1] = filled + count
        measured += looked
        if t >= 0:
            found[i] = t
        if reject:
            rejected[i], largest[i] = True, worst
    return out_start, kept[: out_start[-1]].copy(), measured


@nb.njit(cache=True)
def _near(organs, zone, candidates, cell, narrow, pad, kept):  # type: ignore[no-untyped-def]  # numba infers
    """Keep the triangles that matter to a cell and, where it is narrow, are not proven clear of it.

    Returns:
        How many were kept, none of a rejected cell; the triangle that rejects it, or else lies nearest, -1 for none;
        whether one was measured; whether the cell is rejected, and how far an axis of it is from that triangle at most.
    """
    corners, group, limits = organs
    axis, cosine, sine, nearest = zone
    u, four, radius, bulge, lengths = cell
    cos_radius, sin_radius = np.cos(radius), np.sin(radius)
    count, best, found, looked = 0, np.inf, -1, False
    for t in candidates:
        toward = axis[t, 0] * u[0] + axis[t, 1] * u[1] + axis[t, 2] * u[2]
        if _elsewhere(toward, cosine[t], sine[t], cos_radius, sin_radius):
            continue
        if narrow:
            looked = True
            limit, unlike = limits[group[t]], HOPELESS * radius * nearest[t]
            clear, hit, worst, gap = _beside_cell(corners[t], u, four, bulge, limit, pad, lengths, unlike)
            if clear:
                continue
            if hit == 4:
                return 0, t, looked, True, worst
            if gap < best:
                best, found = gap, t
        kept[count] = t
        count += 1
    return count, found, looked, False, np.nan


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _elsewhere(toward, cosine, sine, cos_radius, sin_radius):  # type: ignore[no-untyped-def]  # numba infers
    """Whether two cones have no direction in common: by the cosine between their axes, and cosines, sines of radii."""
    sine_of_both = sin_radius * cosine + cos_radius * sine
    return sine_of_both > 0.0 and toward < cos_radius * cosine - sin_radius * sine  # else they pass pi together


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _beside_cell(t, u, four, bulge, limit, pad, lengths, unlike):  # type: ignore[no-untyped-def]  # numba infers
    """Relation of a triangle to a cell about u: clear of it or not; its `_corners`, where a witness is not too unlike.

    Last, by how much the line along u is farther from it than the limit.
    """
    width, side = _beside(u, t)
    if _apart(t, side, u, four, bulge, limit + pad, lengths[1]):
        return True, 0, 0.0, 0.0
    hit, worst = 0, 0.0
    if width + unlike < limit or width <= 0.0:
        hit, worst = _corners(t, four, lengths[0], limit - pad, bulge)
    return False, hit, worst, width - limit


@nb.njit(cache=True)
def _grown(kept, filled, size):  # type: ignore[no-untyped-def]  # numba infers
    larger = np.empty(size, np.int64)
    larger[:filled] = kept[:filled]
    return larger


@nb.njit(cache=True)
def _corners(triangle, four, length, limit, bulge):  # type: ignore[no-untyped-def]  # numba infers
    """How many of a cell's corner axes come nearer to a triangle than the limit, and how far any axis of it may be.

    Whatever bulges out of the corners is taken from the limit, and added to the largest distance at them.
    """
    more = BULGES * length * bulge
    limit -= more
    a = (triangle[0], triangle[1], triangle[2])
    b = (triangle[3], triangle[4], triangle[5])
    c = (triangle[6], triangle[7], triangle[8])
    worst, hit = 0.0, 0
    for j in range(4):
        square, _ = axis_triangle((four[j, 0], four[j, 1], four[j, 2]), length, a, b, c)
        worst = max(worst, square)
        hit += limit > 0.0 and square < limit * limit
    return hit, np.sqrt(worst) + more


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _beside(u, t):  # type: ignore[no-untyped-def]  # numba infers
    """Distance of a line through the target from a triangle, and the unit normal that keeps all of it that far.

    In the plane across the line the triangle's shadow is convex, and the foot of the origin on it supports it.
    """
    ta, tb, tc = (
        t[0] * u[0] + t[1] * u[1] + t[2] * u[2],
        t[3] * u[0] + t[4] * u[1] + t[5] * u[2],
        t[6] * u[0] + t[7] * u[1] + t[8] * u[2],
    )
    a = (t[0] - ta * u[0], t[1] - ta * u[1], t[2] - ta * u[2])
    b = (t[3] - tb * u[0], t[4] - tb * u[1], t[5] - tb * u[2])
    c = (t[6] - tc * u[0], t[7] - tc * u[1], t[8] - tc * u[2])
    wa, wb, wc = _normal(u, b, c), _normal(u, c, a), _normal(u, a, b)
    around = (wa >= 0.0 and wb >= 0.0 and wc >= 0.0) or (wa <= 0.0 and wb <= 0.0 and wc <= 0.0)
    if around and wa + wb + wc != 0.0:
        return 0.0, (0.0, 0.0, 0.0)
    best, side = _foot(a, b)
    for p, q in ((b, c), (c, a)):
        square, foot = _foot(p, q)
        if square < best:
            best, side = square, foot
    width = np.sqrt(best)
    if width <= 0.0:
        return 0.0, (0.0, 0.0, 0.0)
    return width, (side[0] / width, side[1] / width, side[2] / width)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _normal(u, p, q):  # type: ignore[no-untyped-def]  # numba infers
    return (
        u[0] * (p[1] * q[2] - p[2] * q[1])
        + u[1] * (p[2] * q[0] - p[0] * q[2])
        + u[2] * (p[0] * q[1] - p[1] * q[0])
    )  # fmt: skip


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _foot(p, q):  # type: ignore[no-untyped-def]  # numba infers
    """The point of the edge p-q that is nearest to the origin, and its squared distance."""
    dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    down = dx * dx + dy * dy + dz * dz
    s = -(p[0] * dx + p[1] * dy + p[2] * dz) / down if down > 0.0 else 0.0
    s = min(max(s, 0.0), 1.0)
    x, y, z = p[0] + s * dx, p[1] + s * dy, p[2] + s * dz
    return x * x + y * y + z * z, (x, y, z)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _apart(t, n, u, four, bulge, limit, length):  # type: ignore[no-untyped-def]  # numba infers
    """Whether a plane keeps a triangle at the limit from every axis of a cell; n is where to look for it.

    Through the target: m·v <= 0 for all directions v of the cell, m·p >= limit for all corners p of the triangle.
    """
    low = min(_along(u, t, 0), _along(u, t, 3), _along(u, t, 6))
    high = max(_along(u, t, 0), _along(u, t, 3), _along(u, t, 6))
    least = 1.0
    tilt = 0.0
    for j in range(4):
        ahead = u[0] * four[j, 0] + u[1] * four[j, 1] + u[2] * four[j, 2]
        aside = n[0] * four[j, 0] + n[1] * four[j, 1] + n[2] * four[j, 2]
        least = min(least, ahead)
        tilt = max(tilt, (aside + bulge) / ahead)
    if least <= bulge:
        return False
    if low >= limit + length or -high >= limit:  # beyond the top of all, or behind the target
        return True
    need = limit * np.sqrt(1.0 + tilt * tilt)
    ahead, least = least, np.inf
    for corner in (0, 3, 6):
        least = min(least, _along(n, t, corner) - tilt * _along(u, t, corner))
    return least >= need or _before_own_plane(t, four, bulge, limit, length, ahead)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _before_own_plane(t, four, bulge, limit, length, ahead):  # type: ignore[no-untyped-def]  # numba infers
    """Whether every axis of a cell ends at the limit or farther before the plane of a triangle, or leads away from it.

    A large triangle (a table, where the image ends) lies next to the axis as a ray and across it as a line: no plane
    along the axis helps. ``ahead`` is the least cosine between the cell's middle and its corners.
    """
    ax, ay, az = t[3] - t[0], t[4] - t[1], t[5] - t[2]
    bx, by, bz = t[6] - t[0], t[7] - t[1], t[8] - t[2]
    m = (ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)
    size = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    if size <= 0.0:
        return False
    size = size if _along(m, t, 0) >= 0.0 else -size
    m = (m[0] / size, m[1] / size, m[2] / size)
    toward = max(
        m[0] * four[0, 0] + m[1] * four[0, 1] + m[2] * four[0, 2],
        m[0] * four[1, 0] + m[1] * four[1, 1] + m[2] * four[1, 2],
        m[0] * four[2, 0] + m[1] * four[2, 1] + m[2] * four[2, 2],
        m[0] * four[3, 0] + m[1] * four[3, 1] + m[2] * four[3, 2],
    )
    nearest = min(_along(m, t, 0), _along(m, t, 3), _along(m, t, 6))
    most = max(toward, 0.0) * (1.0 + bulge) / ahead + bulge
    return nearest - length * most >= limit or (toward + bulge <= 0.0 and nearest >= limit)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _along(n, t, k):  # type: ignore[no-untyped-def]  # numba infers
    return n[0] * t[k] + n[1] * t[k + 1] + n[2] * t[k + 2]
