"""``[needle]`` and ``[tissue.NAME]``: the needle, and what it bends in."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, Strict, model_validator

from puncture_twin.planning.case.toml_types import Number, Section, StructureName, Text, Vector

Force = Annotated[Number, Field(ge=0, le=50)]
Stiffness = Annotated[Number, Field(ge=0, le=100)]
"""Soft tissue has 0.01 to 1, rubber some 10."""


class NeedleSection(Section):
    """The needle: lengths from the tip; the holder is what lies between shaft and flange."""

    length_mm: Annotated[Number, Field(ge=20, le=1000)]
    shaft_mm: Annotated[Number, Field(ge=10, le=1000)]
    diameter_mm: Annotated[Number, Field(ge=0.1, le=20)]
    standoff_mm: Annotated[Number, Field(ge=5, le=1000)] | None = None
    skin_gap_mm: Annotated[Number, Field(ge=6, le=200)] = 10.0  # the least, along the needle; see standoff.py
    holder_diameter_mm: Annotated[Number, Field(ge=1, le=200)] = 30.0
    lengths_mm: tuple[Annotated[Number, Field(ge=20, le=1000)], ...] = ()
    gauge: Annotated[int, Strict()] | None = None
    solid: Annotated[bool, Strict()] | None = None
    bevel_deg: Annotated[Number, Field(ge=0, le=10)] | None = None
    modulus_gpa: Annotated[Number, Field(ge=1, le=1000)] | None = None

    @model_validator(mode="after")
    def _shaft_fits(self) -> Self:
        if self.shaft_mm > self.length_mm:
            raise ValueError(f"shaft_mm {self.shaft_mm:g} is longer than length_mm {self.length_mm:g}")
        least = self.length_mm - self.shaft_mm + 10.0
        if self.lengths_mm and (self.length_mm not in self.lengths_mm or min(self.lengths_mm) < least):
            raise ValueError(f"lengths_mm holds length_mm, and none below {least:g}: the holder, and 10 mm of shaft")
        if self.solid is not None and self.gauge is None:
            raise ValueError("solid belongs to gauge; without one the shaft is solid, of diameter_mm")
        return self


class TissueSection(Section):
    """One tissue."""

    stiffness_n_mm2: Stiffness
    cutting_n: Force = 0.0
    friction_n_mm: Annotated[Number, Field(ge=0, le=1)] = 0.0
    capsule_n: Force = 0.0
    capsule_mm: Annotated[Number, Field(ge=0, le=50)] = 0.0

    @model_validator(mode="after")
    def _capsule_is_whole(self) -> Self:
        if (self.capsule_n > 0) != (self.capsule_mm > 0):
            raise ValueError("capsule_n and capsule_mm go together: force at the rupture, and how far in it is")
        return self


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
