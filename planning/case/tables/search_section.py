"""``[search]`` and ``[ranking]``: which directions are searched, their limits, and what a good one is."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, Strict, model_validator

from puncture_twin.planning.case.tables.structures_section import MAX_STRUCTURES
from puncture_twin.planning.case.toml_types import (
    Anatomical,
    Degrees180,
    Degrees360,
    Number,
    Section,
    Text,
    Vector,
    Weight,
)

Chance = Annotated[Number, Field(ge=0, le=1)]

MAX_DIRECTIONS = 1_000_000
"""Rows of a search: a hemisphere at 0.2 degrees; 2 GB of table with 60 structures."""


class EntryAxes(Section):
    """An entry frame of one's own: where its z and x axes point; y = z × x."""

    z: Anatomical | Vector
    x: Anatomical | Vector


class SearchSection(Section):
    """The grid of directions and the limits at the skin."""

    theta_deg: tuple[Degrees180, Degrees180] = (0.0, 90.0)
    beta_deg: tuple[Degrees360, Degrees360] = (0.0, 360.0)
    step_deg: Annotated[Number, Field(ge=0.05, le=45)] = 1.0
    max_skin_angle_deg: Annotated[Number, Field(gt=0, le=90)] = 60.0
    frame: Literal["ct", "bed"] | EntryAxes | None = None
    trust_labels: Annotated[bool, Strict()] = False
    min_hit: Chance | None = None
    max_touch: Chance | None = None
    max_touch_of: Annotated[dict[Text, Chance], Field(max_length=MAX_STRUCTURES)] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _grid_fits(self) -> Self:
        rows = 1.0
        for low, high in (self.theta_deg, self.beta_deg):
            rows *= (high - low) / self.step_deg + 1
        if rows > MAX_DIRECTIONS:
            raise ValueError(f"step_deg {self.step_deg:g} makes {rows:,.0f} directions; {MAX_DIRECTIONS:,} at most")
        return self

    @model_validator(mode="after")
    def _ranges_ascend(self) -> Self:
        for key in ("theta_deg", "beta_deg"):
            low, high = getattr(self, key)
            if low > high:
                raise ValueError(f"{key} [{low:g}, {high:g}] descends; it is [lowest, highest]")
            if 0 < high - low < self.step_deg:
                raise ValueError(f"step_deg {self.step_deg:g} is larger than the range {key} [{low:g}, {high:g}]")
        return self


class RankingSection(Section):
    """Weights of the cost terms; each term lies in 0..1, see planning/search/ranking.py."""

    clearance: Weight = 1.0
    path_length: Weight = 0.5
    skin_angle: Weight = 0.3
    tissue: Weight = 0.5
    reach: Weight = 0.5
    safe_cone: Weight = 0.5

    @model_validator(mode="after")
    def _one_counts(self) -> Self:
        if not any(getattr(self, name) > 0 for name in type(self).model_fields):
            raise ValueError("every weight is 0; one at least is above")
        return self
