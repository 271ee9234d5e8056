"""Cells of a cap of directions: rectangles in (θ, β) that halve into one another, each inside a known cone.

A cell is [θ0, θ1] x [β0, β1] in the entry frame. Halving tiles it without gap or overlap by construction, also at the
poles, where a rectangle is a spherical triangle. Its cone is the cone about its middle angles through its farthest
corner: docs/concepts/certificate.md proves that it encloses the cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats
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

    theta: Floats
    """Shape (n, 2), lowest and highest puncture angle."""
    beta: Floats
    """Shape (n, 2), lowest and highest azimuth."""

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
        """How each cell is best halved, letters of `SPLITS`, shape (n,).

        Args:
            radius: Of the cells, shape (n,), rad.
            size: The wanted angular diameter, rad: where one half is about as small, no quarters are made.
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

    centres: Floats
    """Shape (n, 3), unit, the middle of each cell."""
    radius: Floats
    """Shape (n,), half-angle of the cone about it that encloses the cell, rad; π where none is known."""
    corners: Floats
    """Shape (n, 4, 3), unit."""
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


class Children(NamedTuple):
    """Parts of cells, and the row of the cell that each is part of, shape (n,)."""

    cells: Cells
    parent: NDArray[np.int64]


def split(cells: Cells, letters: NDArray[np.str_]) -> Children:
    """Halve every cell along the axes of its letter; parts in the order of their cells, low θ first, then low β."""
    kind = np.select([letters == "t", letters == "b"], [0, 1], 2)
    parent = np.repeat(np.arange(len(cells)), _COUNT[kind])
    part = np.arange(len(parent)) - np.repeat(np.cumsum(_COUNT[kind]) - _COUNT[kind], _COUNT[kind])
    t_part, b_part = _PARTS[kind[parent], part].T
    return Children(Cells(_part(cells.theta[parent], t_part), _part(cells.beta[parent], b_part)), parent)


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
