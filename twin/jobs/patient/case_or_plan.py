"""What a command works on that takes a case, or a plan beside its case."""

from __future__ import annotations

from pathlib import Path

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.search.choice import BEST, Choice


def is_plan(source: Path) -> bool:
    """Whether a file is a plan rather than a case: by its name."""
    return source.suffix == ".json"


def case_of(source: Path, case: Path | None, choice: Choice) -> Path | None:
    """The case of a command: its source, or what is named beside a plan; None of a plan without its case.

    Args:
        source: A case, or a plan.
        case: The option ``--case``.
        choice: Which candidate is wanted.

    Raises:
        InputError: A plan with a choice, since it has its direction, or two cases.
    """
    if is_plan(source):
        if choice != BEST:
            raise InputError("a plan has its direction", where=source, allowed="a case, where one is to be chosen")
        return case
    if case is not None:
        raise InputError("two cases", where="--case", allowed="CASE alone, or plan.json --case CASE")
    return source
