"""``[target]``: the point to reach."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from puncture_twin.planning.case.toml_types import Number, Section, StructureName, Text, Vector


class TargetSection(Section):
    """The point to reach: coordinates, or a name in a file of points."""

    position_mm: Vector | None = None
    points: str | None = None
    name: Text = "target"
    structure: StructureName | None = None
    hit_radius_mm: Annotated[Number, Field(gt=0, le=100)] | None = None

    @model_validator(mode="after")
    def _one_position(self) -> Self:
        if (self.position_mm is None) == (self.points is None):
            raise ValueError("needs either position_mm or points (a file, with the target's name), not both")
        if self.structure is None and self.hit_radius_mm is None:
            raise ValueError("needs structure, or hit_radius_mm where the target lies in no structure")
        return self
