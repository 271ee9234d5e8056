"""``[robot]``: the arm, its speeds, and where its base is located."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from puncture_twin.planning.arm.speed_limits import DEFAULT_SPEEDS, HIGHEST
from puncture_twin.planning.arm.urdf.arm_urdf import FLANGE
from puncture_twin.planning.case.tables.limits_section import LimitsSection
from puncture_twin.planning.case.toml_types import Number, Section, Sextuple, Text, Vector


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
