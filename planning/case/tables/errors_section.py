"""The table ``[errors]`` of a case: what each reading, touch and joint may be off by. See docs/concepts/uncertainty.md.

All numbers are standard deviations per axis of normal errors with mean zero; 0 switches a source off.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from puncture_twin.planning.case.toml_types import Anatomical, Number, Section, Vector

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
    surface_mm: Millimetres = 0.0

    @model_validator(mode="after")
    def _cell_or_deviation(self) -> Self:
        for cell, deviation in (("ct_pixel_mm", "ct_in_plane_mm"), ("ct_spacing_mm", "ct_slice_mm")):
            if getattr(self, cell) is not None and getattr(self, deviation) is not None:
                raise ValueError(f"{cell} and {deviation} state the same error; keep one")
        return self
