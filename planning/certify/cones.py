"""Bounding cones of triangles, and for every cell the list of triangles that may matter to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.numba_kernels import nb

ZONE_PAD_RAD = 1e-6
"""Widens every triangle's zone against rounding, which near an angle of 0 is 1e-8."""


@dataclass(frozen=True, eq=False)
class Zones:
    """For m triangles, the directions to which each matters: a cone about the target."""

    axis: Floats
    """Shape (m, 3), unit."""
    cosine: Floats
    """Shape (m,), of the half-angle, below a right angle, as ``sine``; (-1, 0) for all directions."""
    sine: Floats
    farthest: Floats
    """Shape (m,), largest distance of the triangle from the target, mm."""
    nearest: Floats
    """Shape (m,), a distance from the target that no point of the triangle falls short of, mm."""


@dataclass(frozen=True, eq=False)
class Lists:
    """Of each of n cells, the triangles that may matter to it: ``items[start[i]:start[i + 1]]``."""

    start: Ints
    items: Ints

    @classmethod
    def one(cls, items: Ints) -> Lists:
        """Lists with a single list."""
        return cls(np.array([0, len(items)]), items)

    def take(self, rows: Ints) -> Lists:
        """The lists of some cells."""
        sizes = (self.start[1:] - self.start[:-1])[rows]
        start = np.concatenate([[0], np.cumsum(sizes)])
        where = np.arange(start[-1]) - np.repeat(start[:-1] - self.start[rows], sizes)
        return Lists(start, self.items[where])


def zones(corners: Floats, limit: Floats | float) -> Zones:
    """Zones of triangles seen from the origin, grown so that a needle within ``limit`` of a triangle points into it.

    Args:
        corners: Shape (m, 3, 3), mm from the target.
        limit: Shape (m,) or a number; 0 for the directions that hit the triangle, mm.
    """
    limits = np.ascontiguousarray(np.broadcast_to(np.asarray(limit, dtype=np.float64), len(corners)))
    return Zones(*_zones(np.ascontiguousarray(corners), limits, np.cos(ZONE_PAD_RAD), np.sin(ZONE_PAD_RAD)))


@nb.njit(cache=True)
def _zones(corners, limits, cos_pad, sin_pad):  # type: ignore[no-untyped-def]  # numba infers
    count = len(corners)
    axis, cosine, sine = np.zeros((count, 3)), np.full(count, -1.0), np.zeros(count)
    farthest, nearest = np.empty(count), np.empty(count)
    for i in range(count):
        ax, ay, az = corners[i, 0, 0], corners[i, 0, 1], corners[i, 0, 2]
        bx, by, bz = corners[i, 1, 0], corners[i, 1, 1], corners[i, 1, 2]
        cx, cy, cz = corners[i, 2, 0], corners[i, 2, 1], corners[i, 2, 2]
        la, lb, lc = _length(ax, ay, az), _length(bx, by, bz), _length(cx, cy, cz)
        farthest[i] = max(la, lb, lc)
        mx, my, mz = (ax + bx + cx) / 3, (ay + by + cy) / 3, (az + bz + cz) / 3
        spread = max(_length(ax - mx, ay - my, az - mz), _length(bx - mx, by - my, bz - mz))
        spread = max(spread, _length(cx - mx, cy - my, cz - mz))
        nearest[i] = max(0.0, _length(mx, my, mz) - spread - 1e-9)
        axis[i, 2] = 1.0
        if min(la, lb, lc) <= 0.0 or nearest[i] <= limits[i]:
            continue
        tx, ty, tz = ax / la + bx / lb + cx / lc, ay / la + by / lb + cy / lc, az / la + bz / lb + cz / lc
        norm = _length(tx, ty, tz)
        if norm < 0.5:
            continue
        least = min((ax * tx + ay * ty + az * tz) / la, (bx * tx + by * ty + bz * tz) / lb)
        least = min(1.0, least / norm, (cx * tx + cy * ty + cz * tz) / (lc * norm))
        if least < 0.1:
            continue
        # the half-angle is arccos(least) + arcsin(limit / nearest) + pad
        wide, more = np.sqrt(1.0 - least * least), limits[i] / nearest[i]
        rest = np.sqrt(1.0 - more * more)
        c, s = least * rest - wide * more, wide * rest + least * more
        if c <= sin_pad:
            continue
        cosine[i], sine[i] = c * cos_pad - s * sin_pad, s * cos_pad + c * sin_pad
        axis[i, 0], axis[i, 1], axis[i, 2] = tx / norm, ty / norm, tz / norm
    return axis, cosine, sine, farthest, nearest


@nb.njit(cache=True)
def _length(x, y, z):  # type: ignore[no-untyped-def]  # numba infers
    return np.sqrt(x * x + y * y + z * z)


def narrowed(zone: Zones, lists: Lists, parent: Ints, centres: Floats, radius: Floats) -> Lists:
    """Keep of each parent's list what matters to its part: lists of n cells.

    Args:
        parent: Shape (n,), row of each cell's parent.
        centres: Shape (n, 3), unit.
        radius: Shape (n,), rad, at most π/2.
    """
    cone = np.ascontiguousarray(centres), np.cos(radius), np.sin(radius)
    return Lists(*_narrowed(zone.axis, zone.cosine, zone.sine, lists.start, lists.items, parent, *cone))


@nb.njit(cache=True)
def _narrowed(axis, cosine, sine, start, items, parent, centres, cos_radius, sin_radius):  # type: ignore[no-untyped-def]  # numba infers
    count = len(parent)
    out_start = np.zeros(count + 1, np.int64)
    out = np.empty(max(1024, len(items)), np.int64)
    filled = 0
    for i in range(count):
        x, y, z, c, s = centres[i, 0], centres[i, 1], centres[i, 2], cos_radius[i], sin_radius[i]
        first, last = start[parent[i]], start[parent[i] + 1]
        if filled + last - first > len(out):
            grown = np.empty(2 * (filled + last - first), np.int64)
            grown[:filled] = out[:filled]
            out = grown
        for k in range(first, last):
            t = items[k]
            # the angle is at most radius + half, which every angle is once that sum passes pi
            if (
                s * cosine[t] + c * sine[t] <= 0.0
                or axis[t, 0] * x + axis[t, 1] * y + axis[t, 2] * z >= c * cosine[t] - s * sine[t]
            ):
                out[filled] = t
                filled += 1
        out_start[i + 1] = filled
    return out_start, out[:filled].copy()
