"""The interface of clearance engines, and needle-to-organ clearance by whichever engine measures.

An engine is prepared for surfaces once and measures from any target; `measure` adds the verdict at margins, where FCL
decides ties, and `normals_of` the unit vectors from the nearest triangles.
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
    """Distances of n needle axes from k structures, mm.

    Attributes:
        distance: Shape (n, k), least distance of axis i from the surface of structure j; 0 where they intersect.
        depth: Shape (n, k), distance from the target, along the axis, of the axis point nearest to the structure;
            where they intersect, of the first point of intersection.
        nearest: Shape (n, k), a triangle of the structure that is as near, a row of the engine's `triangles`.
    """

    distance: Floats
    depth: Floats
    nearest: Ints32

    def at(self, rows: Ints) -> AxisDistances:
        """The distances of some axes."""
        return AxisDistances(self.distance[rows], self.depth[rows], self.nearest[rows])


class ClearanceEngine(Protocol):
    """A clearance engine: prepared once for a set of surfaces, it measures from any target.

    An engine sees surfaces only. That a needle lies wholly inside a closed surface is the caller's to find, and is
    decided by the target alone, because every axis starts there (see `puncture_twin.planning.clearance.engine`).
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
        """Exact distances of the axes from ``target_ct`` (3,) along ``outward_ct`` (n, 3).

        ``length`` is one number, shape (k,) or (n, k), mm: as long is an axis for each structure. The arrays are the
        caller's to change. Without ``shown`` no progress is reported: the same axes are tested again.
        """
        ...

    def collides(self, structure: int, target_ct: Floats, outward_ct: Floats, length: float, radius: float) -> bool:
        """Whether FCL finds a capsule of this radius about one axis (3,) in contact with one structure."""
        ...

    def of(self, columns: Ints) -> ClearanceEngine:
        """The same engine for some of its structures, in this order; nothing is prepared again."""
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
    """Whether axes come nearer to a structure's surface than a limit, shape (n,); FCL decides what is a tie.

    Args:
        engine: Which measured the distances.
        structure: Its place in the engine.
        target_ct: Shape (3,).
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
class Clearances:
    """Clearances of n candidates from k structures; mm.

    Attributes:
        clearance: Shape (n, k), axis distance minus needle radius, never below minus the radius.
        depth: Shape (n, k), where along the needle, from the target.
        violated: Shape (n, k), the structure demands a margin and does not get it, by its distance or by FCL's word.
    """

    clearance: Floats
    depth: Floats
    violated: NDArray[np.bool_]


def measure(
    engine: ClearanceEngine,
    structures: tuple[Structure, ...],
    target_ct: Floats,
    outward_ct: Floats,
    *,
    length: Floats | float,
    radius: float,
    axes: AxisDistances | None = None,
) -> Clearances:
    """Measure the clearance of all candidates, with the verdict at each margin.

    Every axis starts at the target: where the target lies inside a closed structure, the whole axis is inside it or
    crosses its surface, and the distance is 0 whatever the surfaces say.

    Args:
        engine: Prepared for the meshes of ``structures``, in that order.
        structures: The k structures.
        target_ct: Shape (3,).
        outward_ct: Shape (n, 3), unit vectors.
        length: How far the needle's axis goes from the target, one number, shape (k,) or (n, k), mm.
        radius: Needle radius, mm.
        axes: What the engine has measured of them already; None measures them.
    """
    lengths = np.broadcast_to(np.asarray(length, dtype=np.float64), (len(outward_ct), len(structures)))
    if axes is None:
        axes = engine.measure(target_ct, outward_ct, lengths)
        distance, depth = axes.distance, axes.depth
    else:  # the caller's, who needs them as they are
        distance, depth = axes.distance.copy(order="K"), axes.depth.copy(order="K")  # a structure's row by row
    violated = np.zeros_like(distance, bool)
    for column, structure in enumerate(structures):
        if contains(structure.mesh, target_ct):
            distance[:, column] = depth[:, column] = 0.0
        if structure.demands_margin:
            limit = radius + structure.margin_mm
            violated[:, column] = too_near(
                engine, column, target_ct, outward_ct, lengths[:, column], distance[:, column], limit
            )
    distance -= radius
    return Clearances(distance, depth, violated)


def normals_of(triangles: Sequence[Floats], target_ct: Floats, outward_ct: Floats, axes: AxisDistances) -> Floats:
    """Unit vectors from each surface to each axis, shape (n, k, 3); NaN where they intersect.

    Nothing is searched again. Where several points of a surface are equally near, it is any one of them.

    Args:
        triangles: Of the engine that measured: of each surface, shape (m, 9), corners in rows, mm.
        target_ct: Shape (3,), where the axes start.
        outward_ct: Shape (n, 3), unit.
        axes: Measured from there, their ``nearest`` rows of ``triangles``.
    """
    target, outward = (np.array(given, dtype=np.float64, order="C") for given in (target_ct, outward_ct))
    normal = np.empty((len(triangles), len(outward), 3))
    for row, corners in enumerate(triangles):
        nearest, distance, depth = (np.array(of[:, row]) for of in (axes.nearest, axes.distance, axes.depth))
        axis_normals(corners, nearest, distance, depth, target, outward, normal[row])
    return normal.transpose(1, 0, 2)


@nb.njit(cache=True)
def axis_normals(triangles, nearest, distance, depth, target, outward, normal):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``normal`` (n, 3): unit, from the nearest point of each axis' nearest triangle to the axis; NaN on contact.

    Args:
        triangles: Shape (m, 9), corners in rows, mm.
        nearest: Shape (n,), row of each axis' nearest triangle.
        distance: Shape (n,), mm.
        depth: Shape (n,), of the nearest axis point, mm.
        target: Shape (3,), where the axes start.
        outward: Shape (n, 3), unit.
        normal: Filled.
    """
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
