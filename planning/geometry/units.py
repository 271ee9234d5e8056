"""In which unit of length a file speaks.

The command line reads the names of units from here, so numpy is not imported.
"""

from __future__ import annotations

from enum import StrEnum

from puncture_twin.planning.base.errors import InputError


class Unit(StrEnum):
    """A unit of length that a file may use."""

    MM = "mm"
    CM = "cm"
    M = "m"

    @property
    def mm(self) -> float:
        """How many millimetres one of this unit is."""
        return {Unit.MM: 1.0, Unit.CM: 10.0, Unit.M: 1000.0}[self]


def parse_unit(text: str, *, where: str) -> Unit:
    """The unit of length that a text names.

    Raises:
        InputError: If it names none.
    """
    if text.strip() in tuple(Unit):
        return Unit(text.strip())
    raise InputError(f"unknown unit of length {text!r}", where=where, allowed=", ".join(Unit))
