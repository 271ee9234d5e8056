"""What a check of plausibility found: a code and numbers for a program, a sentence for a person."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum


class Severity(StrEnum):
    """How much a finding weighs."""

    NOTE = "note"
    WARNING = "warning"
    REFUSAL = "refusal"


@dataclass(frozen=True)
class Finding:
    """One thing that the inputs say of each other.

    Attributes:
        code: What kind of thing it is, in one word.
        severity: A refusal stops the work, a warning stands in every result, a note is for those who look.
        sentence: For a person.
        numbers: What was measured, by name with its unit.
        way_out: Of a refusal, what would be accepted.
    """

    code: str
    severity: Severity
    sentence: str
    numbers: Mapping[str, float | list[float] | str] = field(default_factory=dict)
    way_out: str = ""

    def document(self) -> dict[str, object]:
        """As it stands under ``findings`` of ``--json``."""
        return {
            "code": self.code,
            "severity": str(self.severity),
            "numbers": dict(self.numbers),
            "sentence": self.sentence,
        }
