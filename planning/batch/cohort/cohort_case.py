"""One case of a cohort, before anything of it has been read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from puncture_twin.planning.case.options import NO_OPTIONS, CaseOptions


@dataclass(frozen=True)
class CohortCase:
    """One case with its options.

    Attributes:
        stated: As the cohort writes it.
        path: The case file, or the folder that holds ``case.toml``.
        name: What people call it; "" leaves it to the case.
        options: What is stated in place of what the case states.
    """

    stated: str
    path: Path
    name: str = ""
    options: CaseOptions = NO_OPTIONS


MOST_CASES = 1_000_000
"""Of one cohort: more is a slip in a grid of options."""
