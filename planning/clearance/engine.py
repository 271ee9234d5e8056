"""What a clearance engine answers: the one interface between the search and whoever measures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.clearance.near_faces import NearFaces


@dataclass(frozen=True, eq=False)
class AxisDistances:
    """How far needle axes are from structures, mm.

    Attributes:
        distance: Shape (n, k), least distance of axis i from the surface of structure j; 0 where they meet.
        depth: Shape (n, k), distance from the target, along the axis, of the axis point nearest to the structure;
            where they meet, of the first meeting point.
        normal: Shape (n, k, 3), unit, from the structure's nearest point to that axis point; NaN where they meet; None
            where it was not asked for.
    """

    distance: Floats
    depth: Floats
    normal: Floats | None = None


class ClearanceEngine(Protocol):
    """Prepared once for a set of surfaces, asked for any target.

    An engine sees surfaces only. That a needle lies wholly inside a closed surface is the caller's to find, and is
    decided by the target alone, because every axis starts there (see `puncture_twin.planning.clearance.measure`).
    """

    def measure(
        self,
        target_ct: Floats,
        outward_ct: Floats,
        length: Floats | float,
        *,
        normals: bool = False,
        shown: bool = True,
    ) -> AxisDistances:
        """Exact distances of the axes from ``target_ct`` (3,) along ``outward_ct`` (n, 3).

        ``length`` is one number or shape (k,), mm: as long is an axis for each structure. With ``normals`` each answer
        says from where it is nearest. Without ``shown`` no progress is told: the same axes are asked again.
        """
        ...

    def collides(self, structure: int, target_ct: Floats, outward_ct: Floats, length: float, radius: float) -> bool:
        """FCL's own word on whether a capsule of this radius about one axis (3,) touches one structure."""
        ...

    def near(
        self, structure: int, origin_ct: Floats, outward_ct: Floats, length: float, reach: tuple[float, float]
    ) -> NearFaces:
        """All faces of one structure within reach (mm, at the axis' start and at its end) of an axis, and some more."""
        ...
