"""Words and numbers in exported files: nothing that a plan names can leave its comment or its string."""

from __future__ import annotations

import string
import textwrap
from collections.abc import Iterable, Sequence
from importlib.metadata import version

import numpy as np

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


SENTENCE_WIDTH = 110
"""Columns of a warning's lines in a comment."""

WARNINGS_UNKNOWN = "warnings: not known, the plan's file is older than their statement; plan again"


def warning_lines(warnings: Sequence[str] | None) -> list[str]:
    """The warnings of a plan for a comment: how many, then each whole, on as many lines as it needs.

    >>> warning_lines(("the 'skin' is open; a box",))
    ['1 warning stood when this was planned:', 'warning: the skin is open, a box']
    """
    if warnings is None:
        return [WARNINGS_UNKNOWN]
    if not warnings:
        return ["warnings: none stood when this was planned"]
    lines = [line for one in warnings for line in textwrap.wrap(f"warning: {plain_sentence(one)}", SENTENCE_WIDTH)]
    return [f"{counted(warnings)} stood when this was planned:", *lines]


def counted(warnings: Sequence[str]) -> str:
    """How many there are, in words that can be read aloud."""
    return f"{len(warnings)} warning{'s' if len(warnings) > 1 else ''}"


def plain_sentence(text: str) -> str:
    """A sentence whole, in the characters of ``PLAIN`` and commas: no quotes, and a comma for a semicolon."""
    text = text.translate({ord("'"): None, ord('"'): None, ord(";"): ",", ord("%"): "percent"})
    return "".join(character if character in PLAIN or character == "," else "_" for character in text)


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
        f"direction: theta {np.degrees(plan.theta):g} deg, beta {np.degrees(plan.beta):g} deg",
        "this plan was " + ("checked against its case again" if case_checked else "NOT checked against its case again"),
        *warning_lines(plan.warnings),
        *notes,
    ]
    return [f"# {line}" for line in lines]
