"""The table ``[errors]`` of a servo case: what may be off, and by how much. See docs/reference/servo-case.md.

All numbers but the play are standard deviations per axis of normal errors with mean zero; 0 switches a source off.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from puncture_twin.planning.case.toml_types import Number, Section

Millimetres = Annotated[Number, Field(ge=0, le=50)]
Degrees = Annotated[Number, Field(ge=0, le=10)]
Pixels = Annotated[Number, Field(ge=0, le=200)]
DetectionPixels = Annotated[Number, Field(ge=1e-4, le=50)]
Part = Annotated[Number, Field(ge=0, le=0.2)]
"""Of a whole that is 1."""


class ServoErrorsSection(Section):
    """The declared errors; what is left out takes its default (`declared_errors`)."""

    arm: Literal["calibrated", "nominal"] = "calibrated"
    link_mm: Millimetres | None = None
    twist_deg: Degrees | None = None
    joint_deg: Degrees | None = None
    backlash_deg: Degrees | None = None
    repeatability_deg: Degrees | None = None
    ball_offset_mm: Millimetres = 0.3
    tip_offset_mm: Millimetres = 0.3
    needle_direction_deg: Degrees = 0.2
    camera_turn_deg: Degrees = 0.23
    camera_shift_mm: Millimetres = 3.0
    camera_axis_px: Pixels = 8.0
    camera_focal: Part = 0.01
    lens: tuple[Part, Part, Part, Part] = (0.02, 0.02, 0.0005, 0.0005)
    ball_px: DetectionPixels | None = None
    measuring_arm_mm: Millimetres | None = None
    marker_mm: Millimetres | None = None
    target_mm: Millimetres | None = None
    head_shift_mm: Millimetres = 0.0
    head_turn_deg: Degrees = 0.0


class ServoRehearsalSection(Section):
    """From what the truth of a workcell is drawn, where that is not what the belief declares."""

    errors: ServoErrorsSection | None = None
