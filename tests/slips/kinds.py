"""What a kind of slip is, and what can come of one."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import InputError

REFUSED, WARNED, TOLD, RIGHT, SILENT = "refused", "warned", "told", "right", "silent-wrong"
"""Told: it is said that this cannot be known. Right: nothing is said, and what comes out is as without the slip."""


class Answer(NamedTuple):
    """What came of a draw: one of the words above, and the code of what was said."""

    how: str
    code: str = ""


class Kind(NamedTuple):
    """A kind of slip.

    Attributes:
        name: In words.
        share: Of a thousand draws.
        draw: With a generator, an empty folder, and whether it slips; without, the same input is drawn right.
        may_pass: Of the slips, how many are known to pass in silence: a hole that is measured, and only shrinks.
    """

    name: str
    share: int
    draw: Callable[[np.random.Generator, Path, bool], Answer]
    may_pass: float = 0.0


def answer(call: Callable[[], Answer | None]) -> Answer:
    """What a call comes to; None for the right thing, in silence."""
    try:
        return call() or Answer(RIGHT)
    except InputError as error:
        return Answer(REFUSED, error.code or error.what[:60])
