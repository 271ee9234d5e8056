"""Needle-to-organ clearance: the interface of clearance engines, and margins and normals by any of them.

An engine gives the distance of needle axes from surfaces. `measure` makes clearances of them, and says which violate a
margin (FCL decides ties); `normals_of` gives the unit vectors from the nearest triangles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Floats, Ints, Ints32
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.blocks import Blocks
from puncture_twin.planning.geometry.containment import contains
from puncture_twin.planning.geometry.triangle_distance import nearest_point


@dataclass(frozen=True, eq=False)
class AxisDistances:
    """Distances of n needle axes from k structures, mm."""

    distance: Floats
    """Shape (n, k), least distance of axis i from the surface of structure j; 0 where they intersect."""
    depth: Floats
    """Shape (n, k), distance from the target, along the axis, of the axis point nearest to the structure; where they
    intersect, of the first point of intersection."""
    nearest: Ints32
    """Shape (n, k), a nearest triangle of the structure, as a row of the engine's `triangles`."""

    def at(self, rows: Ints) -> AxisDistances:
        """The distances of some axes."""
        return AxisDistances(self.distance[rows], self.depth[rows], self.nearest[rows])


class ClearanceEngine(Protocol):
    """A clearance engine: prepared once for a set of surfaces, it measures from any target.

    An engine sees surfaces only, not what is inside of them. A needle wholly inside a closed surface is found by
    `measure`, from the target alone, because every axis starts there.
    """

    @property
    def triangles(self) -> tuple[Floats, ...]:
        """Triangles of each structure, shape (m, 9), corners in rows, mm: the rows of `AxisDistances.nearest`."""
        ...

    @property
    def blocks(self) -> tuple[Blocks, ...]:
        """Packed blocks of each structure, in which `near_faces` finds what a displaced needle can touch."""
        ...

    def measure(
        self, target_ct: Floats, outward_ct: Floats, length: Floats | float, *, shown: bool = True
    ) -> AxisDistances:
        """Exact distances of n axes from k structures, as arrays that the caller may change.

        Args:
            target_ct: Shape (3,), where every axis starts, mm.
            outward_ct: Shape (n, 3), unit vectors along the axes.
            length: Of the axes, one number, shape (k,) or (n, k), mm: it may differ between structures.
            shown: Whether progress is reported; not where axes are measured again.
        """
        ...

    def collides(self, structure: int, target_ct: Floats, outward_ct: Floats, length: float, radius: float) -> bool:
        """Whether FCL finds a capsule of this radius about one axis (3,) in contact with one structure."""
        ...

    def of(self, columns: Ints) -> ClearanceEngine:
        """This engine for some of its structures, in the order of ``columns``; nothing is prepared again."""
        ...


NEAR_THRESHOLD_MM = 1e-4
"""Within this of a margin FCL's capsule collision decides: its own tolerance is 1e-6 mm."""
ROUNDING_MM = 1e-9
"""An axis that is too near by more than this is too close even where FCL does not see it: a capsule that overlaps a
triangle by less than 1e-6 mm is free to FCL."""


def too_near(
    engine: ClearanceEngine,
    structure: int,
    target_ct: Floats,
    outward_ct: Floats,
    length: Floats | float,
    distance: Floats,
    limit: float,
) -> NDArray[np.bool_]:
    """Whether axes come nearer to a structure's surface than a limit, shape (n,).

    Nearer than limit - 1e-9 mm is too near, farther than limit + 1e-4 mm is not; between them, a tie, FCL's capsule
    collision decides. So FCL can accept an axis that is at most 1e-9 mm too near.

    Args:
        target_ct: Shape (3,), mm.
        outward_ct: Shape (n, 3), unit vectors.
        length: Of the axes, one number or shape (n,), mm.
        distance: Shape (n,), of the axes from the surface, mm.
        limit: Needle radius plus margin, mm.
    """
    nearer, lengths = distance < limit, np.broadcast_to(length, len(outward_ct))
    for row in np.flatnonzero(np.abs(distance - limit) < NEAR_THRESHOLD_MM):
        nearer[row] = distance[row] < limit - ROUNDING_MM or engine.collides(
            structure, target_ct, outward_ct[row], float(lengths[row]), limit
        )
    return nearer


@dataclass(frozen=True, eq=False)
class MeasuredClearances:
    """Clearances of n candidates from k structures; mm."""

    clearance: Floats
    """Shape (n, k), axis distance minus needle radius, never below minus the radius."""
    depth: Floats
    """Shape (n, k), distance from the target, along the needle, of the point nearest to the structure."""
    violated: NDArray[np.bool_]
    """Shape (n, k), whether the clearance is less than the structure's margin; FCL decides ties."""


def measure_clearances(
    engine: ClearanceEngine,
    structures: tuple[Structure, ...],
    target_ct: Floats,
    outward_ct: Floats,
    *,
    length: Floats | float,
    radius: float,
    axes: AxisDistances | None = None,
) -> MeasuredClearances:
    """Clearance of n candidates from k structures, and whether it violates each margin.

        clearance = distance of the axis from the surface - needle radius;  violated: clearance < margin

    Args:
        engine: Prepared for the meshes of ``structures``, in that order.
        target_ct: Shape (3,), mm.
        outward_ct: Shape (n, 3), unit vectors.
        length: Of the needle's axis from the target, one number, shape (k,) or (n, k), mm.
        radius: Needle radius, mm.
        axes: Their distances where the engine has measured them already; None measures them.
    """
    lengths = np.broadcast_to(np.asarray(length, dtype=np.float64), (len(outward_ct), len(structures)))
    if axes is None:
        axes = engine.measure(target_ct, outward_ct, lengths)
        distance, depth = axes.distance, axes.depth
    else:  # the caller needs its arrays unchanged; order "K" keeps each structure's distances contiguous
        distance, depth = axes.distance.copy(order="K"), axes.depth.copy(order="K")
    violated = np.zeros_like(distance, bool)
    for column, structure in enumerate(structures):
        # Every axis starts at the target: where that is inside, each axis is inside too or crosses the surface.
        if contains(structure.mesh, target_ct):
            distance[:, column] = depth[:, column] = 0.0
        if structure.demands_margin:
            limit = radius + structure.margin_mm
            violated[:, column] = too_near(
                engine, column, target_ct, outward_ct, lengths[:, column], distance[:, column], limit
            )
    distance -= radius
    return MeasuredClearances(distance, depth, violated)


def normals_of(triangles: Sequence[Floats], target_ct: Floats, outward_ct: Floats, axes: AxisDistances) -> Floats:
    """Unit vectors from each surface's nearest point to each axis, shape (n, k, 3); NaN where they intersect.

    They follow from the nearest triangles, without another search; of several nearest points any one is taken.

    Args:
        triangles: Of the engine that measured; for each surface shape (m, 9), corners in rows, mm.
        target_ct: Shape (3,), where the axes start, mm.
        outward_ct: Shape (n, 3), unit vectors.
        axes: Distances of these axes; ``nearest`` are rows of ``triangles``.
    """
    target, outward = (np.array(given, dtype=np.float64, order="C") for given in (target_ct, outward_ct))
    normal = np.empty((len(triangles), len(outward), 3))
    for row, corners in enumerate(triangles):
        nearest, distance, depth = (np.array(of[:, row]) for of in (axes.nearest, axes.distance, axes.depth))
        axis_normals(corners, nearest, distance, depth, target, outward, normal[row])
    return normal.transpose(1, 0, 2)


@nb.njit(cache=True)
def axis_normals(triangles, nearest, distance, depth, target, outward, normal):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``normal`` (n, 3) with the unit vectors of one surface (m, 9); NaN on contact: see `normals_of`."""
    for i in range(len(outward)):
        if distance[i] <= 0.0:
            normal[i] = math.nan
            continue
        x, y = target[0] + depth[i] * outward[i, 0], target[1] + depth[i] * outward[i, 1]
        z = target[2] + depth[i] * outward[i, 2]
        px, py, pz = nearest_point(triangles[nearest[i]].reshape(3, 3), x, y, z)
        dx, dy, dz = x - px, y - py, z - pz
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length == 0.0:
            normal[i] = math.nan
            continue
        normal[i, 0], normal[i, 1], normal[i, 2] = dx / length, dy / length, dz / length
