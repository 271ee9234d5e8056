"""``[rehearsal]``: what the twin's ground truth is drawn from."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Strict

from puncture_twin.planning.case.tables.errors_section import ErrorsSection
from puncture_twin.planning.case.toml_types import NotNegative, Section


class RehearsalSection(Section):
    """What the twin's truth is drawn from; the planner never reads it."""

    seed: Annotated[int, Strict(), Field(ge=0, lt=2**31)] = 0
    truth_base: str | None = None
    fle_ct_mm: NotNegative = 0.5
    fle_touch_mm: NotNegative = 0.1
    joint_offset_deg: NotNegative = 0.02
    control: Literal["impedance", "admittance", "position"] = "impedance"
    errors: ErrorsSection | None = None
