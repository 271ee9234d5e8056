"""What a clearance engine answers: the one interface between the search and whoever measures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from puncture_twin.planning.base.arrays import Floats, Ints, Ints32
from puncture_twin.planning.clearance.kernels.blocks import Blocks


@dataclass(frozen=True, eq=False)
class AxisDistances:
    """How far needle axes are from structures, mm.

    Attributes:
        distance: Shape (n, k), least distance of axis i from the surface of structure j; 0 where they meet.
        depth: Shape (n, k), distance from the target, along the axis, of the axis point nearest to the structure;
            where they meet, of the first meeting point.
        nearest: Shape (n, k), a triangle of the structure that is as near, a row of the engine's `triangles`.
    """

    distance: Floats
    depth: Floats
    nearest: Ints32

    def at(self, rows: Ints) -> AxisDistances:
        """Those of some axes."""
        return AxisDistances(self.distance[rows], self.depth[rows], self.nearest[rows])


class ClearanceEngine(Protocol):
    """Prepared once for a set of surfaces, wanted any target.

    An engine sees surfaces only. That a needle lies wholly inside a closed surface is the caller's to find, and is
    decided by the target alone, because every axis starts there (see `puncture_twin.planning.clearance.measure`).
    """

    @property
    def triangles(self) -> tuple[Floats, ...]:
        """Of each structure, shape (m, 9), corners in rows, mm: what `AxisDistances.nearest` counts."""
        ...

    @property
    def blocks(self) -> tuple[Blocks, ...]:
        """Of each structure: among them `near_faces` finds what a displaced needle can meet."""
        ...

    def measure(
        self, target_ct: Floats, outward_ct: Floats, length: Floats | float, *, shown: bool = True
    ) -> AxisDistances:
        """Exact distances of the axes from ``target_ct`` (3,) along ``outward_ct`` (n, 3).

        ``length`` is one number, shape (k,) or (n, k), mm: as long is an axis for each structure. The arrays are the
        caller's to change. Without ``shown`` no progress is told: the same axes are tested again.
        """
        ...

    def collides(self, structure: int, target_ct: Floats, outward_ct: Floats, length: float, radius: float) -> bool:
        """FCL's own word on whether a capsule of this radius about one axis (3,) touches one structure."""
        ...

    def of(self, columns: Ints) -> ClearanceEngine:
        """The same engine for some of its structures, in this order; nothing is prepared again."""
        ...
