"""Which tests said nothing about an arm: a green run must not be read as if it had."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

ARM_PROPERTY = "arm"
"""Of a test's report: it comes back from other processes too, and into JUnit's file."""

CHECKED = "checked"


def arm_notes(reports: Iterable[object]) -> list[str]:
    """A line for each case and reason for which an arm was not checked; none where it always was.

    Args:
        reports: Of pytest; only what it calls the call of a test is counted.
    """
    notes: Counter[str] = Counter()
    for report in reports:
        if getattr(report, "when", "") == "call":
            properties = dict(getattr(report, "user_properties", ()))
            if properties.get(ARM_PROPERTY, CHECKED) != CHECKED:
                notes[f"{properties['case']}: arm {properties[ARM_PROPERTY]}"] += 1
    return [f"{line} ({count} test{'s' if count != 1 else ''})" for line, count in notes.items()]
