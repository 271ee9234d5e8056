"""What the plugin asks of a run of pytest, and what it says at its end: light, since every run wants it.

A green run must not be read as if arms had been checked, where they were not.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import pytest

ARM_PROPERTY = "arm"
"""Of a test's report: it comes back from other processes too, and into JUnit's file."""

CHECKED = "checked"

UPDATE = "--collision-update"
SEVERAL = f"{UPDATE} rewrites files: run it in one process, without -n"


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


def add_flag(parser: pytest.Parser) -> None:
    """Tell pytest of it."""
    text = "rewrite the numbers that *.collision.toml files expect; never a verdict"
    parser.getgroup("collision").addoption(UPDATE, action="store_true", help=text)


def updating(config: pytest.Config) -> bool:
    """Whether numbers are to be rewritten.

    Raises:
        UsageError: By several processes at once.
    """
    wanted = bool(config.getoption(UPDATE))
    if wanted and config.getoption("numprocesses", None):
        raise pytest.UsageError(SEVERAL)
    return wanted
