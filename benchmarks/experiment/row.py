"""A figure of the experiment beside what is demanded of it."""

from __future__ import annotations

from typing import NamedTuple


class Row(NamedTuple):
    """One figure.

    Attributes:
        what: What was measured, with its unit.
        value: As it is printed.
        demand: What it should be, in words; empty where nothing is demanded.
        met: Whether it is so.
    """

    what: str
    value: str
    demand: str
    met: bool

    @classmethod
    def at_most(cls, what: str, value: float, limit: float, digits: str = ".3g") -> Row:
        """A figure with an upper limit."""
        return cls(what, format(value, digits), f"<= {limit:g}", bool(value <= limit))

    @classmethod
    def between(cls, what: str, value: float, low: float, high: float, digits: str = ".3f") -> Row:
        """A figure between two limits."""
        return cls(what, format(value, digits), f"{low:g} to {high:g}", bool(low <= value <= high))
