"""``[robot]``: the arm, its speeds, and where its base is located."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from puncture_twin.planning.arm.speed_limits import DEFAULT_SPEEDS, HIGHEST
from puncture_twin.planning.arm.urdf.arm_urdf import FLANGE
from puncture_twin.planning.case.toml_types import Number, Section, Sextuple, Text, Vector

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


class MountSection(Section):
    """Where the robot's base stands in the CT, when no markers say it."""

    position_mm: Vector
    x_axis: Vector
    z_axis: Vector


class RobotSection(Section):
    """The arm: one of the table, by its name, or one's own, by a URDF."""

    model: str = "ur3"
    urdf: str | None = None
    flange: Text = FLANGE
    limits: LimitsSection | None = None
    home_deg: Sextuple | None = None
    mount: MountSection | None = None
    tip_speed_mm_s: Annotated[Number, Field(ge=1, le=HIGHEST.tip_speed_mm_s)] = DEFAULT_SPEEDS.tip_speed_mm_s
    insertion_speed_mm_s: Annotated[Number, Field(ge=0.1, le=HIGHEST.insertion_speed_mm_s)] = (
        DEFAULT_SPEEDS.insertion_speed_mm_s
    )
    joint_speed_fraction: Annotated[Number, Field(ge=0.01, le=1)] = DEFAULT_SPEEDS.joint_speed_fraction
    joint_acceleration_fraction: Annotated[Number, Field(ge=0.01, le=1)] = DEFAULT_SPEEDS.joint_acceleration_fraction

    @model_validator(mode="after")
    def _one_arm(self) -> Self:
        if self.urdf is not None and "model" in self.model_fields_set:
            raise ValueError("model and urdf both say which arm it is; keep one")
        if self.urdf is None and "flange" in self.model_fields_set:
            raise ValueError("flange names a link of urdf, which is not there")
        return self

    @model_validator(mode="after")
    def _insertion_is_the_slower(self) -> Self:
        if self.insertion_speed_mm_s > self.tip_speed_mm_s:
            raise ValueError(
                f"insertion_speed_mm_s {self.insertion_speed_mm_s:g} is above tip_speed_mm_s {self.tip_speed_mm_s:g}"
            )
        return self
