"""Words and numbers in exported files: nothing that a plan names can leave its comment or its string."""

from __future__ import annotations

import string
from collections.abc import Iterable
from importlib.metadata import version

from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_document import PLAN_VERSION

PLAIN = frozenset(string.ascii_letters + string.digits + " ._-+:/()")
"""What may stand in a comment or a string of any of the formats: nothing that ends, escapes or nests one."""

LONGEST = 200
"""Characters of one name; a longer one is cut."""


def plain_text(text: str) -> str:
    """A name with every character outside ``PLAIN`` turned into an underscore, cut at ``LONGEST``.

    >>> plain_text('liver"); halt #')
    'liver_)_ halt _'
    """
    return "".join(character if character in PLAIN else "_" for character in text[:LONGEST])


def heading(plan: Plan, notes: Iterable[str], *, case_checked: bool) -> list[str]:
    """Comment lines that say what a file is, what it was made from, and how to read it.

    Args:
        plan: The plan that the file holds.
        case_checked: Whether the plan was compared with its case when it was exported.
        notes: Further lines.
    """
    lines = [
        "research software, not a medical device",
        f"made by puncture-twin {version('puncture-twin')} from a plan of version {PLAN_VERSION}, seed {plan.seed}",
        f"case: {plain_text(plan.case_name)}",
        *(f"input: {plain_text(f'{one.role}: {one.path}')} sha256 {plain_text(one.sha256)}" for one in plan.inputs),
        f"robot: {plain_text(plan.model.name)}",
        "this plan was " + ("checked against its case again" if case_checked else "NOT checked against its case again"),
        *notes,
    ]
    return [f"# {line}" for line in lines]
