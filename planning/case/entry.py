"""The two angles (θ, β) around the target, and the needle that they place (Chen 2019, Eq. 10-15).

A regular grid of (θ, β): which directions are neighbours, what solid angle each stands for, what lies beyond.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.case.tables import EntryAxes
from puncture_twin.planning.geometry.rigid import frame_of_axes
from puncture_twin.planning.geometry.spaces import Space, to_lps

ANATOMICAL_LPS = MappingProxyType({
    "left": (1.0, 0.0, 0.0), "right": (-1.0, 0.0, 0.0),
    "posterior": (0.0, 1.0, 0.0), "anterior": (0.0, -1.0, 0.0),
    "head": (0.0, 0.0, 1.0), "feet": (0.0, 0.0, -1.0),
})  # fmt: skip
"""Unit vectors of the body's directions in LPS."""
AXES_PARALLEL = 0.999
"""|cos| above which two axes do not span a frame (2.6 degrees)."""
GRID_SLACK, SAME_ANGLE = 1e-9, 1e-9
"""Fraction of a step by which rounding may miss the end of a range; and radians within which θ is at a pole."""


@dataclass(frozen=True, eq=False)
class Directions:
    """A set of entry directions."""

    theta: Floats  # shape (n,), puncture angle from the entry frame's +z, rad
    beta: Floats  # shape (n,), azimuth from +x in its xy plane, rad
    outward_ct: Floats  # shape (n, 3), unit vectors in the CT frame, from the target outward
    grid: AngleGrid | None = None  # the regular grid that they are, row by row; None for any others

    def __len__(self) -> int:
        return len(self.theta)


@dataclass(frozen=True, eq=False)
class NeedlePose:
    """Needle tip and top (flange end) in the CT frame, shape (..., 3), mm."""

    tip_ct: Floats
    top_ct: Floats


def entry_frame(frame: str | EntryAxes | None, space: Space, *, where: str | Path = "search.frame") -> Floats:
    """Rotation R_ct_entry of the entry frame: columns x, y = z × x and z in LPS (or the local frame), shape (3, 3).

    Args:
        frame: ``"ct"`` (axes of the case's space), ``"bed"`` (x to the head, z to the front), explicit axes in that
            space, or None for its default: ``"ct"`` for a local space, ``"bed"`` for a patient.

    Raises:
        InputError: The axes do not span a frame.
    """
    if frame is None:
        frame = "ct" if space is Space.LOCAL else "bed"
    if frame == "ct":
        return to_lps(np.eye(3), space).T
    axes = EntryAxes(z="anterior", x="head") if frame == "bed" else frame
    if not isinstance(axes, EntryAxes):
        refuse(f"frame '{frame}' is not known", where, "ct, bed, or z and x axes", "unknown_frame")
    z, x = (lps_axis(axis, space) for axis in (axes.z, axes.x))
    lengths = np.linalg.norm(z), np.linalg.norm(x)
    if min(lengths) == 0 or abs(z @ x) > AXES_PARALLEL * lengths[0] * lengths[1]:
        refuse("search.frame: its axes are parallel or zero", where, "two axes", "axes_parallel")
    return frame_of_axes(z, x)


def lps_axis(axis: str | tuple[float, float, float], space: Space) -> Floats:
    """An axis of a space, of any length, or a direction of the body by its name, in LPS (or the local frame): (3,)."""
    if isinstance(axis, str):
        return np.array(ANATOMICAL_LPS[axis])
    return to_lps(np.array([axis]), space)[0]


def outward(theta: Floats | float, beta: Floats | float) -> Floats:
    """u(θ, β) = (sin θ cos β, sin θ sin β, cos θ) in the entry frame (Chen 2019, Eq. 10-11), shape (..., 3).

    >>> outward(0.0, 1.0).tolist()
    [0.0, 0.0, 1.0]
    """
    theta, beta = np.broadcast_arrays(np.asarray(theta, dtype=float), np.asarray(beta, dtype=float))
    sine = np.sin(theta)
    return np.stack([sine * np.cos(beta), sine * np.sin(beta), np.cos(theta)], axis=-1)


def angles(outward_entry: Floats) -> tuple[Floats, Floats]:
    """The angles (θ in 0..π, β in 0..2π) of unit vectors in the entry frame; β is 0 at the poles."""
    x, y, z = np.moveaxis(np.asarray(outward_entry, dtype=float), -1, 0)
    sine = np.hypot(x, y)
    beta = np.where(sine > 0, np.mod(np.arctan2(y, x), 2 * np.pi), 0.0)
    return np.arctan2(sine, z), beta


def needle_pose(target_ct: Floats, outward_ct: Floats, *, standoff: Floats | float, length: float) -> NeedlePose:
    """Tip f + r u and top f + (r + l) u of a needle of length l that points at f (Chen 2019, Eq. 12-15).

    Of a target f (3,), directions u (..., 3), and standoffs r, a number or (...,); mm.
    """
    r = np.asarray(standoff, dtype=float)[..., None]
    return NeedlePose(target_ct + r * outward_ct, target_ct + (r + length) * outward_ct)


def direction(theta: Floats | float, beta: Floats | float, R_ct_entry: Floats) -> Directions:
    """One direction, or several, shape (n,), rad."""
    one, other = (np.array(angles, dtype=float, ndmin=1) for angles in (theta, beta))
    return _directions(one, other, R_ct_entry)


def grid(theta: tuple[float, float], beta: tuple[float, float], step: float, R_ct_entry: Floats) -> Directions:
    """Every (θ, β) of a regular grid, θ outermost; β = 360° is left out where the range is the full circle.

    Of the lowest and highest angles and their step, rad: ends belong to the grid where the step meets them; and the
    rotation of the entry frame, shape (3, 3).
    """
    azimuths = _steps(beta, step)
    full_circle = bool(len(azimuths) > 1 and azimuths[-1] - azimuths[0] >= 2 * np.pi - GRID_SLACK)
    if full_circle:
        azimuths = azimuths[:-1]
    polar = _steps(theta, step)
    directions = _directions(np.repeat(polar, len(azimuths)), np.tile(azimuths, len(polar)), R_ct_entry)
    return replace(directions, grid=AngleGrid(polar, azimuths, step, full_circle))


def _steps(limits: tuple[float, float], step: float) -> Floats:
    count = int(np.floor((limits[1] - limits[0]) / step + GRID_SLACK)) + 1
    return np.asarray(limits[0] + step * np.arange(count), dtype=np.float64)


def _directions(theta: Floats, beta: Floats, R_ct_entry: Floats) -> Directions:
    return Directions(read_only(theta), read_only(beta), read_only(outward(theta, beta) @ R_ct_entry.T))


@dataclass(frozen=True, eq=False)
class AngleGrid:
    """Puncture angles (m,) by azimuths (k,), ascending, row by row with θ outermost; rad.

    ``full_circle``: the last azimuth's next neighbour is the first.
    """

    theta: Floats  # shape (m,), ascending
    beta: Floats  # shape (k,), ascending
    step: float
    full_circle: bool

    def __len__(self) -> int:
        return len(self.theta) * len(self.beta)

    def solid_angle(self) -> Floats:
        """Solid angle of each direction, shape (m k,), sr: to the middle between neighbours, within the grid.

        The integral of sin θ dθ dβ over each cell: together they are the grid's whole solid angle.
        """
        inner = (self.theta[1:] + self.theta[:-1]) / 2
        edges = np.concatenate([self.theta[:1], inner, self.theta[-1:]])
        width = np.full(len(self.beta), self.step)
        if not self.full_circle:
            width[[0, -1]] = 0.5 * self.step if len(self.beta) > 1 else 0.0
        return np.outer(-np.diff(np.cos(edges)), width).ravel()

    def neighbours(self) -> Ints:
        """Pairs of rows one step apart, shape (e, 2); all rows at a pole are one direction, and so neighbours."""
        rows = np.arange(len(self)).reshape(len(self.theta), len(self.beta))
        at_pole = rows[(self.theta < SAME_ANGLE) | (self.theta > np.pi - SAME_ANGLE)]
        pairs = [(rows[:-1], rows[1:]), (rows[:, :-1], rows[:, 1:]), (at_pole[:, :-1], at_pole[:, 1:])]
        if self.full_circle:
            pairs.insert(2, (rows[:, -1:], rows[:, :1]))
        return np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])

    def beyond(self) -> tuple[Floats, Floats]:
        """Directions (θ, β) one step outside of the grid, which were not searched, shape (b,) each."""
        none, polar = np.empty(0), [self.theta[0] - self.step, self.theta[-1] + self.step]
        beyond = [self.theta[0] > SAME_ANGLE, self.theta[-1] < np.pi - SAME_ANGLE]
        azimuths = none if self.full_circle else np.array([self.beta[0] - self.step, self.beta[-1] + self.step])
        rows = (np.array(polar)[beyond], self.beta), (self.theta, azimuths)
        theta = np.concatenate([np.repeat(one, len(other)) for one, other in rows])
        return np.clip(theta, 0.0, np.pi), np.concatenate([np.tile(other, len(one)) for one, other in rows])
