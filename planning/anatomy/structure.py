"""A named surface, and what it means to a needle."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from puncture_twin.planning.geometry.mesh import TriangleMesh


class Role(StrEnum):
    """What a structure means to a needle."""

    AVOID = "avoid"
    TRAVERSE = "traverse"
    TARGET = "target"
    SKIN = "skin"
    UNKNOWN = "unknown"


@dataclass(frozen=True, eq=False)
class Structure:
    """A named surface with a role.

    Attributes:
        name: Unique in the case.
        role: What it means to the needle.
        margin_mm: The clearance that it demands, where its role demands one.
        mesh: In the CT frame, mm.
        source: The file it comes from, and the label in it.
        outside: Whether it is outside of the body, where the needle waits at its standoff: it is then checked
            against the needle's axis up to where the flange waits, not only to where the flange ends.
        voxel_mm: The longest side of the voxels that it was made of, mm; 0 for one that no volume shows.
    """

    name: str
    role: Role
    margin_mm: float
    mesh: TriangleMesh
    source: str
    outside: bool = False
    voxel_mm: float = 0.0

    @property
    def demands_margin(self) -> bool:
        """Whether a needle too close to it is rejected."""
        return self.role in {Role.AVOID, Role.UNKNOWN}
