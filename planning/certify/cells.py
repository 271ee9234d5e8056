"""Cells of a cap of directions: rectangles in (θ, β) that halve into one another, each inside a known cone.

A cell is [θ0, θ1] x [β0, β1] in the entry frame. Halving tiles it without gap or overlap by construction, also at the
poles, where a rectangle is a spherical triangle. Its cone is the cone about its middle angles through its farthest
corner: docs/concepts/certificate.md proves that it encloses the cell. Triangles have bounding cones too, and every
cell the list of those that may matter to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.case.entry import outward

ROUNDING_RAD = 1e-12
"""Added to a cell's radius: thousands of times the rounding of its corners."""
WIDEST_BETA = np.pi
"""A wider cell has no enclosing cone here: its farthest point need not be a corner."""
SQUARE = 1.5
"""A cell longer than this times its width is halved along its length only."""
NEARLY = 1.25
"""Half a square cell has 0.79 times its diameter."""
OFF_CENTRE = (0.6373, 0.5719)
"""Where in a cell (fraction of θ, fraction of β) its test ray runs: meshes are regular, so not through the middle."""
SPLITS = "tbq"
"""How a cell is halved: along θ, along β, or both (quartered)."""
SQUARE_DEGREES = (180 / np.pi) ** 2
"""Square degrees in a steradian."""


@dataclass(frozen=True, eq=False)
class Cells:
    """n cells of the entry frame, rad."""

    theta: Floats  # shape (n, 2), lowest and highest puncture angle
    beta: Floats  # shape (n, 2), lowest and highest azimuth

    def __len__(self) -> int:
        return len(self.theta)

    def at(self, theta_part: float, beta_part: float) -> Floats:
        """Unit vectors of the entry frame at the same place of every cell, shape (n, 3); (0.5, 0.5) is its centre."""
        theta = self.theta[:, 0] + theta_part * (self.theta[:, 1] - self.theta[:, 0])
        beta = self.beta[:, 0] + beta_part * (self.beta[:, 1] - self.beta[:, 0])
        return outward(theta, beta)

    def centres(self) -> Floats:
        """The middle of every cell, unit vectors of the entry frame, shape (n, 3)."""
        return self.at(0.5, 0.5)

    def radius(self) -> Floats:
        """Half-angle of the cone about the centre that encloses each cell, shape (n,), rad; π where none is known."""
        return self.cones(np.eye(3)).radius

    def solid_angle(self) -> Floats:
        """Area on the unit sphere, shape (n,), sr."""
        middle, half = self.theta.mean(axis=1), 0.5 * np.ptp(self.theta, axis=1)
        return np.asarray(2 * np.sin(middle) * np.sin(half) * np.ptp(self.beta, axis=1))

    def splits(self, radius: Floats, size: float = 0.0) -> NDArray[np.str_]:
        """How each cell of these radii (n,), rad, is best halved, letters of `SPLITS`, shape (n,).

        Where one half is about as small as the wanted angular diameter, rad, no quarters are made.
        """
        tall = self.theta[:, 1] - self.theta[:, 0]
        widest = np.clip(np.pi / 2, self.theta[:, 0], self.theta[:, 1])
        wide = self.beta[:, 1] - self.beta[:, 0]
        across = wide * np.sin(widest)
        best = np.where(tall > SQUARE * across, "t", np.where(across > SQUARE * tall, "b", "q"))
        nearly = (best == "q") & (2 * radius <= NEARLY * size)
        best = np.where(nearly, np.where(tall >= across, "t", "b"), best)
        return np.where(wide > WIDEST_BETA / 2, "b", best)

    def take(self, rows: NDArray[np.int64] | Bools) -> Cells:
        """Some of the cells, by rows."""
        return Cells(self.theta[rows], self.beta[rows])

    def cones(self, R_ct_entry: Floats) -> Cones:
        """The cells as seen in the CT frame."""
        n = len(self)
        cones = Cones(np.empty((n, 3)), np.empty(n), np.empty((n, 4, 3)), np.empty(n))
        R = np.ascontiguousarray(R_ct_entry)
        _cones(self.theta, self.beta, R, cones.centres, cones.radius, cones.corners, cones.bulge)
        return cones


@dataclass(frozen=True, eq=False)
class Cones:
    """Cones that enclose n cells, in the CT frame."""

    centres: Floats  # shape (n, 3), unit, the middle of each cell
    radius: Floats
    """Shape (n,), half-angle of the cone about it that encloses the cell, rad; π where none is known."""
    corners: Floats  # shape (n, 4, 3), unit
    bulge: Floats
    """Shape (n,), every direction of the cell is a sum of its corners, with weights that are not negative and add up to
    at least 1, and of a vector no longer than this."""


@nb.njit(cache=True)
def _cones(theta, beta, R, centres, radius, corners, bulge):  # type: ignore[no-untyped-def]  # numba infers
    for i in range(len(theta)):
        low, high, first, last = theta[i, 0], theta[i, 1], beta[i, 0], beta[i, 1]
        up = (np.sin(low), np.sin(high), np.sin(low + 0.5 * (high - low)))
        along = (np.cos(low), np.cos(high), np.cos(low + 0.5 * (high - low)))
        x = (np.cos(first), np.cos(last), np.cos(first + 0.5 * (last - first)))
        y = (np.sin(first), np.sin(last), np.sin(first + 0.5 * (last - first)))
        for axis in range(3):
            centres[i, axis] = up[2] * (R[axis, 0] * x[2] + R[axis, 1] * y[2]) + along[2] * R[axis, 2]
        chord = 0.0
        for end in range(4):
            t, b = end // 2, end % 2
            square = 0.0
            for axis in range(3):
                value = up[t] * (R[axis, 0] * x[b] + R[axis, 1] * y[b]) + along[t] * R[axis, 2]
                corners[i, end, axis] = value
                square += (value - centres[i, axis]) ** 2
            chord = max(chord, square)
        wide = last - first
        radius[i] = 2 * np.arcsin(min(1.0, 0.5 * np.sqrt(chord))) + ROUNDING_RAD if wide <= WIDEST_BETA else np.pi
        from_pole = 1.0 if low < np.pi / 2 < high else max(up[0], up[1])
        bulge[i] = 2 * from_pole * np.sin(wide / 4) ** 2 + ROUNDING_RAD


def split(cells: Cells, letters: NDArray[np.str_]) -> tuple[Cells, Ints]:
    """Halve every cell along the axes of its letter, in the order of their cells, low θ first, then low β.

    Beside the parts comes the row of the cell that each is part of, shape (n,).
    """
    kind = np.select([letters == "t", letters == "b"], [0, 1], 2)
    parent = np.repeat(np.arange(len(cells)), _COUNT[kind])
    part = np.arange(len(parent)) - np.repeat(np.cumsum(_COUNT[kind]) - _COUNT[kind], _COUNT[kind])
    t_part, b_part = _PARTS[kind[parent], part].T
    return Cells(_part(cells.theta[parent], t_part), _part(cells.beta[parent], b_part)), parent


_COUNT = np.array([2, 2, 4])
_PARTS = np.array(
    [[[0, 2], [1, 2], [2, 2], [2, 2]], [[2, 0], [2, 1], [2, 2], [2, 2]], [[0, 0], [0, 1], [1, 0], [1, 1]]]
)
"""Low half 0, high half 1, or the whole 2, of θ and of β."""


def _part(ranges: Floats, which: NDArray[np.int64]) -> Floats:
    middle = 0.5 * (ranges[:, 0] + ranges[:, 1])
    low = np.where(which == 1, middle, ranges[:, 0])
    return np.stack([low, np.where(which == 0, middle, ranges[:, 1])], axis=1)


def nearest_cell(theta: Floats, beta: Floats, cells: Cells) -> Floats:
    """Angle from each direction to the nearest of the cells, (n,), rad; 0 inside, π where there is none at all."""
    theta, beta = np.atleast_1d(np.asarray(theta, dtype=float)), np.atleast_1d(np.asarray(beta, dtype=float))
    cone = cells.centres(), np.cos(cells.radius()), np.sin(cells.radius())
    return np.asarray(_nearest(theta, beta, outward(theta, beta), cells.theta, cells.beta, *cone))


@nb.njit(cache=True)
def _nearest(theta, beta, rays, cell_theta, cell_beta, centres, cos_radius, sin_radius):  # type: ignore[no-untyped-def]  # numba infers
    found = np.full(len(theta), np.pi)
    for i in range(len(theta)):
        best = -1.0  # cosine of the least angle
        sine, cosine = np.sin(theta[i]), np.cos(theta[i])
        for j in range(len(cell_theta)):
            middle = rays[i, 0] * centres[j, 0] + rays[i, 1] * centres[j, 1] + rays[i, 2] * centres[j, 2]
            across = np.sqrt(max(0.0, 1.0 - middle * middle))
            if middle < cos_radius[j] and middle * cos_radius[j] + across * sin_radius[j] < best - 1e-12:
                continue  # not even the cell's cone comes so near
            aside = _outside(beta[i], cell_beta[j, 0], cell_beta[j, 1])
            along = sine * np.cos(aside)
            # on the meridian at this azimuth the angle's cosine is r cos(x - peak)
            low, high = cell_theta[j, 0], cell_theta[j, 1]
            best = max(best, along * np.sin(low) + cosine * np.cos(low), along * np.sin(high) + cosine * np.cos(high))
            peak = np.arctan2(along, cosine)
            if low < peak < high:
                best = max(best, np.sqrt(along * along + cosine * cosine))
        if best >= 1.0 - 1e-15:
            found[i] = 0.0
        elif len(cell_theta) > 0:
            found[i] = np.arccos(best)
    return found


@nb.njit(cache=True)
def _outside(beta, low, high):  # type: ignore[no-untyped-def]  # numba infers
    """Angle from an azimuth to a range of azimuths, around the circle; 0 inside."""
    turn = 2 * np.pi
    past = (beta - low) % turn
    if past <= high - low:
        return 0.0
    return min(past - (high - low), turn - past)


ZONE_PAD_RAD = 1e-6
"""Widens every triangle's zone against rounding, which near an angle of 0 is 1e-8."""


@dataclass(frozen=True, eq=False)
class Zones:
    """For m triangles, the directions to which each matters: a cone about the target."""

    axis: Floats  # shape (m, 3), unit
    cosine: Floats
    """Shape (m,), of the half-angle, below a right angle, as ``sine``; (-1, 0) for all directions."""
    sine: Floats
    farthest: Floats  # shape (m,), largest distance of the triangle from the target, mm
    nearest: Floats  # shape (m,), a distance from the target that no point of the triangle falls short of, mm


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
    """Zones of triangles (m, 3, 3), mm, seen from the origin, into which every needle within a limit points.

    The limit, mm, is (m,) or a number; 0 is for the directions that hit the triangle.
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
    """Keep of each parent's list what matters to its part: lists of n cells, by rows of parents (n,).

    Cells have unit centres (n, 3) and radii (n,), rad, of π/2 at most.
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
