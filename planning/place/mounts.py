"""Mounts of an arm: where each may be placed about the target, the base's pose there, and the directions to be reached.

A pose is written as ``[robot.mount]``; each organ-safe direction counts by the solid angle that it represents.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.settings import Obstacle
from puncture_twin.planning.case.tables import MountBounds, MountName, MountSection
from puncture_twin.planning.geometry.rigid import frame_xz, pose
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.reach.standoff import standoffs
from puncture_twin.planning.search.candidates import Candidates

Range = tuple[float, float]

FREE_MM = 100.0
"""By how much the default bounds go beyond what upper arm, forearm and needle span together."""
ABOVE_MM = 200.0
"""A floor mount may stand so much higher than the target, a ceiling or side mount so much lower, by default."""
RAIL_MM = 100.0
"""Height of a base at the rail above or below the table's top, at most, by default."""
ROUNDS_MM = 50.0
"""Default bounds are multiples of this."""
STRAIGHT_UP_MM = 1.0
"""A base whose axis passes the target this close has no direction away from it."""
FACINGS: Mapping[str, tuple[int, int, int]] = MappingProxyType(
    {"to +along": (1, 0, 0), "to -along": (-1, 0, 0), "to +across": (0, 1, 0), "to -across": (0, -1, 0)}
)
"""A side mount's base axis, toward the target, in the bed frame."""
POSITION_DIGITS = 1
"""Decimals of positions, 0.1 mm: no base is set up more exactly."""
AXIS_DIGITS = 6
"""Axes are written to six digits: 1e-3 mm at a metre."""


@dataclass(frozen=True)
class Region:
    """A region for bases of one kind, in the bed frame about the target."""

    mount: MountName
    facing: str
    axis: tuple[int, int, int]  # the base's z axis, unit
    low: tuple[float, float, float]  # lowest position of the base's origin, mm
    high: tuple[float, float, float]

    @property
    def name(self) -> str:
        """Mount and facing."""
        return f"{self.mount} {self.facing}".strip()

    def lattice(self, step_mm: float) -> Floats:
        """Positions at a step, centred in the region, shape (n, 3), mm."""
        axes = []
        for low, high in zip(self.low, self.high, strict=True):
            count = math.floor((high - low) / step_mm) + 1
            first = (low + high - (count - 1) * step_mm) / 2
            axes.append(first + step_mm * np.arange(count))
        return np.array(list(product(*axes)))

    def around(self, position: Floats, step_mm: float) -> Floats:
        """The neighbours of a position in a grid of that step, those of them in the region, shape (n, 3), mm."""
        steps = np.array([s for s in product((-1.0, 0.0, 1.0), repeat=3) if any(s)])
        near = np.clip(position + step_mm * steps, self.low, self.high)
        return np.unique(near[np.abs(near - position).max(axis=1) > 0], axis=0)


@dataclass(frozen=True)
class Site:
    """One place for the base."""

    region: Region
    position: tuple[float, float, float]
    """The base's origin in the bed frame: along, across, up from the target, mm."""

    def T_bed_base(self) -> Floats:  # noqa: N802  # the field writes T_a_b
        """The base's pose (4, 4), mm; its x axis leads away from the target, which the arm so reaches for at q1 = 0."""
        z, at = np.array(self.region.axis, dtype=float), np.array(self.position)
        x = at - z * (z @ at)
        if np.linalg.norm(x) < STRAIGHT_UP_MM:
            x = np.eye(3)[0] if abs(z[0]) < 0.5 else np.eye(3)[2]
        x /= np.linalg.norm(x)
        return pose(frame_xz(x, z), at)


def regions(case: Case, T_ct_bed: Floats) -> tuple[Region, ...]:
    """The case's regions for a base. Raises InputError: A rail is wanted, and no table is there to which it belongs."""
    settings, model = case.place, case.robot.model
    table = next((o for o in case.obstacles if o.name == settings.table and o.frame == "ct"), None)
    mounts = settings.mounts or ("floor", "rail", "ceiling", "side")
    if table is None and settings.mounts is not None and "rail" in mounts:
        what = f"place.mounts has a rail, and no obstacle '{settings.table}' of frame ct is the table"
        refuse(what, case.path, "an [[obstacle]] of that name, or place.table", "no_table")
    span = abs(model.a2) + abs(model.a3) + case.needle.length_mm + FREE_MM
    reach = ROUNDS_MM * math.ceil(span / ROUNDS_MM)  # default distance of a base from the target, rounded up
    regions: list[Region] = []
    for mount in mounts:
        if mount == "rail":
            regions += [] if table is None else _rails(case, table, T_ct_bed, reach)
        elif mount == "side":
            toward = {1: (-reach, 0.0), -1: (0.0, reach), 0: (-reach, reach)}  # level, to the target's side
            for facing, axis in FACINGS.items():
                sides = (toward[axis[0]], toward[axis[1]], (-ABOVE_MM, reach))
                regions.append(_region("side", facing, axis, settings.side, sides))
        else:
            heights = (-reach, ABOVE_MM) if mount == "floor" else (-ABOVE_MM, reach)
            up = (0, 0, 1) if mount == "floor" else (0, 0, -1)
            bounds = settings.floor if mount == "floor" else settings.ceiling
            regions.append(_region(mount, "", up, bounds, ((-reach, reach), (-reach, reach), heights)))
    return tuple(regions)


def _region(
    mount: MountName, facing: str, axis: tuple[int, int, int], bounds: MountBounds, defaults: tuple[Range, ...]
) -> Region:
    stated = (bounds.along_mm, bounds.across_mm, bounds.height_mm)
    low, high = zip(*(s if s is not None else d for s, d in zip(stated, defaults, strict=True)), strict=True)
    return Region(mount, facing, axis, low, high)


def _rails(case: Case, table: Obstacle, T_ct_bed: Floats, reach: float) -> list[Region]:
    half = np.abs(T_ct_bed[:3, :3].T) @ np.asarray(table.size_mm) / 2
    centre = T_ct_bed[:3, :3].T @ (np.asarray(table.center_mm) - T_ct_bed[:3, 3])
    bounds = case.place.rail
    height = bounds.height_mm if bounds.height_mm is not None else (-RAIL_MM, RAIL_MM)
    top = float(centre[2] + half[2])
    regions = []
    for facing, side in (("+across", 1.0), ("-across", -1.0)):
        across = float(centre[1] + side * (half[1] + case.place.rail_gap_mm))
        defaults = ((-reach, reach), (across, across), (0.0, 0.0))
        heights = MountBounds(along_mm=bounds.along_mm, height_mm=(top + height[0], top + height[1]))
        regions.append(_region("rail", facing, (0, 0, 1), heights, defaults))
    return regions


def mount_section(T_ct_base: Floats, space: Space) -> MountSection:
    """The section that states a pose (4, 4), mm, in the case's space, rounded."""
    # LPS to RAS is its own inverse.
    position, x, z = to_lps(np.stack([T_ct_base[:3, 3], T_ct_base[:3, 0], T_ct_base[:3, 2]]), space)
    at, x_axis, z_axis = _rounded(position, POSITION_DIGITS), _rounded(x, AXIS_DIGITS), _rounded(z, AXIS_DIGITS)
    return MountSection(position_mm=at, x_axis=x_axis, z_axis=z_axis)


def mount_lines(mount: MountSection) -> str:
    """The lines to paste into a case."""
    keys = ("position_mm", "x_axis", "z_axis")
    return "\n".join(["[robot.mount]", *(f"{key} = {list(getattr(mount, key))}" for key in keys)])


def _rounded(vector: Floats, digits: int) -> tuple[float, float, float]:
    x, y, z = (float(value) + 0.0 for value in np.round(vector, digits))  # + 0.0 makes -0.0 a plain 0
    return x, y, z


SAME_RING_DIGITS = 7
"""θ equal to so many digits (rad) belong to one ring of the grid."""


@dataclass(frozen=True, eq=False)
class WantedDirections:
    """n directions to be reached, each with the solid angle that it represents."""

    outward_ct: Floats  # shape (n, 3), unit, from the target outward
    standoff_mm: Floats  # shape (n,), tip to target before the insertion
    weight: Floats  # shape (n,), fraction of the organ-safe solid angle that each stands for

    def __len__(self) -> int:
        return len(self.weight)

    def only(self, rows: NDArray[np.bool_]) -> WantedDirections:
        """Some of the directions, with their weights."""
        return WantedDirections(self.outward_ct[rows], self.standoff_mm[rows], self.weight[rows])

    def order(self, count: int) -> NDArray[np.int64]:
        """All rows, shape (n,): the first ``count`` each as far as can be from those before, then the others."""
        chosen = [int(np.argmax(self.weight))]
        cosine = self.outward_ct @ self.outward_ct[chosen[0]]
        while len(chosen) < min(count, len(self)):
            cosine[chosen[-1]] = np.inf  # of the same direction twice, each row once
            chosen.append(int(np.argmin(cosine)))  # farthest-point sampling
            cosine = np.maximum(cosine, self.outward_ct @ self.outward_ct[chosen[-1]])
        return np.concatenate([chosen, np.setdiff1d(np.arange(len(self)), chosen)])

    def standing_for_all(self, rows: NDArray[np.int64]) -> WantedDirections:
        """Some of the directions, each weighted by all that are nearest to it."""
        nearest = np.argmax(self.outward_ct @ self.outward_ct[rows].T, axis=1)
        weight = np.bincount(nearest, self.weight, minlength=len(rows)).astype(np.float64)
        return WantedDirections(self.outward_ct[rows], self.standoff_mm[rows], weight)

    def spread(self, count: int) -> WantedDirections:
        """At most ``count`` directions, evenly spread, with the weight of all."""
        return self if count >= len(self) else self.standing_for_all(self.order(count)[:count])


def wanted_directions(case: Case, candidates: Candidates) -> WantedDirections:
    """The safe rows of a search, in their order."""
    rows = np.flatnonzero(candidates.safe)
    weight = ring_weights(candidates.theta, case.search.step)[rows]
    standoff = standoffs(case.needle, candidates.path.length[rows], candidates.path.skin_angle[rows])
    return WantedDirections(candidates.outward_ct[rows], standoff, weight / weight.sum() if len(rows) else weight)


def ring_weights(theta: Floats, step: float) -> Floats:
    """The solid angle, up to a factor, of each cell of a grid of (θ, β), by θ (n,) and step, rad: denser near θ = 0."""
    low, high = np.maximum(theta - step / 2, 0.0), np.minimum(theta + step / 2, np.pi)
    _, ring, sizes = np.unique(np.round(theta, SAME_RING_DIGITS), return_inverse=True, return_counts=True)
    return np.asarray((np.cos(low) - np.cos(high)) / sizes[ring])
