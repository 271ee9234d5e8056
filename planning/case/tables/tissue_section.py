"""The tables ``[tissue.PATTERN]`` of a case: what a needle feels there. See docs/concepts/needle-and-tissue.md."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from puncture_twin.planning.case.toml_types import Number, Section

Force = Annotated[Number, Field(ge=0, le=50)]
Stiffness = Annotated[Number, Field(ge=0, le=100)]
"""Soft tissue has 0.01 to 1, rubber some 10."""


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
