"""Limits of the arm's joints that a case states: for joints whose URDF has none, and narrower ones for any arm."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from puncture_twin.planning.arm.urdf.limits import NOTHING_STATED, StatedLimits
from puncture_twin.planning.case.toml_types import Number, Section

Turn = Annotated[Number, Field(ge=-720, le=720)]
Turns = tuple[Turn, Turn, Turn, Turn, Turn, Turn]
Speed = Annotated[Number, Field(gt=0, le=720)]
Speeds = tuple[Speed, Speed, Speed, Speed, Speed, Speed]


class LimitsSection(Section):
    """The angles and speeds of six joints, from the base on; degrees."""

    lowest_deg: Turns | None = None
    highest_deg: Turns | None = None
    max_speed_deg_s: Speeds | None = None

    @model_validator(mode="after")
    def _ranges_ascend(self) -> Self:
        if (self.lowest_deg is None) != (self.highest_deg is None):
            raise ValueError("lowest_deg and highest_deg go together")
        for joint, (low, high) in enumerate(zip(self.lowest_deg or (), self.highest_deg or (), strict=True)):
            if not low < high:
                raise ValueError(f"joint {joint + 1}: lowest_deg {low:g} is not below highest_deg {high:g}")
        return self


def stated_limits(section: LimitsSection | None) -> StatedLimits:
    """The limits in radians; nothing where the case states none."""
    if section is None:
        return NOTHING_STATED
    angles = (
        None
        if section.lowest_deg is None
        else np.radians(np.stack([section.lowest_deg, section.highest_deg or ()], axis=1))
    )
    return StatedLimits(angles, None if section.max_speed_deg_s is None else np.radians(section.max_speed_deg_s))
