"""``[errors]`` and ``[rehearsal]``: what is declared to err, and the truth that a rehearsal draws instead."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, Strict, model_validator

from puncture_twin.planning.case.toml_types import Anatomical, NotNegative, Number, Section, Vector

Millimetres = Annotated[Number, Field(ge=0, le=100)]
Degrees = Annotated[Number, Field(ge=0, le=10)]
Cell = Annotated[Number, Field(gt=0, le=100)]


class ErrorsSection(Section):
    """The declared errors; what is left out takes its default, which for the CT follows from pixel and slices."""

    ct_pixel_mm: Cell | None = None
    ct_spacing_mm: Cell | None = None
    ct_in_plane_mm: Millimetres | None = None
    ct_slice_mm: Millimetres | None = None
    bed_axis: Anatomical | Vector | None = None
    touch_mm: Millimetres | None = None
    target_mm: Millimetres | None = None
    marker_noise: Literal["declared", "found"] = "declared"
    arm: Literal["calibrated", "nominal"] = "calibrated"
    link_mm: Millimetres | None = None
    twist_deg: Degrees | None = None
    joint_deg: Degrees | None = None
    repeatability_deg: Degrees = 0.003
    joint_drift_deg: Degrees | None = None
    tip_offset_mm: Millimetres = 0.3
    needle_direction_deg: Degrees = 0.2
    surface_mm: Millimetres | None = None

    @model_validator(mode="after")
    def _cell_or_deviation(self) -> Self:
        for cell, deviation in (("ct_pixel_mm", "ct_in_plane_mm"), ("ct_spacing_mm", "ct_slice_mm")):
            if getattr(self, cell) is not None and getattr(self, deviation) is not None:
                raise ValueError(f"{cell} and {deviation} state the same error; keep one")
        return self


class RehearsalSection(Section):
    """What the twin's truth is drawn from; the planner never reads it."""

    seed: Annotated[int, Strict(), Field(ge=0, lt=2**31)] = 0
    truth_base: str | None = None
    fle_ct_mm: NotNegative = 0.5
    fle_touch_mm: NotNegative = 0.1
    joint_offset_deg: NotNegative = 0.02
    control: Literal["impedance", "admittance", "position"] = "impedance"
    errors: ErrorsSection | None = None
