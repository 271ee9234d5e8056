"""The known name that was likely meant by an unknown one: another capital, a letter too many, two letters swapped."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

LEAST_ALIKE = 0.6
"""Of two names, by difflib's ratio, without capitals."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A question that names the nearest known name; empty where none is near.

    >>> did_you_mean("arota", ["liver", "aorta"]), did_you_mean("m1", ["M1", "M2"]), did_you_mean("x", ["liver"])
    ("; did you mean 'aorta'?", "; did you mean 'M1'?", '')
    """
    plain = {one.casefold(): one for one in known}
    near = difflib.get_close_matches(name.casefold(), plain, n=1, cutoff=LEAST_ALIKE)
    return f"; did you mean '{plain[near[0]]}'?" if near else ""
