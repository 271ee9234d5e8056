"""The table ``[breathing]`` of a case. See docs/concepts/breathing.md."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, Strict, model_validator

from puncture_twin.planning.case.toml_types import Anatomical, Number, Section, Text, Vector

Position = Annotated[Number, Field(ge=0, le=1)]
Weight = Annotated[Number, Field(ge=0, le=2)]
"""Of what moves more than the target, such as the dome of a liver over a lesion deep in it, a weight is above 1."""

MOST_PATTERNS = 1000


class BreathingSection(Section):
    """The keys; positions s are 0 at exhale and 1 at full inhale."""

    amplitude_mm: Annotated[Number, Field(ge=0, le=100)]
    direction: Anatomical | Vector = "feet"
    weights: Annotated[dict[Text, Weight], Field(max_length=MOST_PATTERNS)]
    phases: Annotated[int, Strict(), Field(ge=1, le=64)] = 8
    exponent: Annotated[int, Strict(), Field(ge=1, le=6)] = 2
    scanned_at: Position = 0.0
    gate: Position | None = None

    @model_validator(mode="after")
    def _full_inhale_is_a_phase(self) -> Self:
        if self.phases > 1 and self.phases % 2:
            raise ValueError(f"phases {self.phases}: an even number, so that full inhale is one of them, or 1")
        return self
