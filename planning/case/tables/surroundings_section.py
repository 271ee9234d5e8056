"""``[[obstacle]]`` and ``[gantry]``: what is located around the patient."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from puncture_twin.planning.case.toml_types import Anatomical, Length, Name, Number, Section, Vector


class ObstacleSection(Section):
    """A box in the workcell (table, gantry side), axes parallel to its frame's."""

    name: Name
    frame: Literal["ct", "base"]
    center_mm: Vector
    size_mm: tuple[Length, Length, Length]


class GantrySection(Section):
    """A CT gantry: a wall with a round bore. ``axis`` and ``up`` are the bore's directions before the tilt."""

    bore_diameter_mm: Annotated[Number, Field(ge=200, le=5000)]
    center_mm: Vector
    thickness_mm: Annotated[Number, Field(ge=10, le=5000)]
    wall_mm: Annotated[Number, Field(ge=10, le=5000)] = 600.0
    tilt_deg: Annotated[Number, Field(ge=-45, le=45)] = 0.0
    axis: Anatomical | Vector | None = None
    up: Anatomical | Vector | None = None
