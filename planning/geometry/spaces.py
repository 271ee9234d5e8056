"""Spaces and units that a file may state, and conversion to LPS and mm.

Patient spaces differ in the sign of two axes: LPS counts toward the patient's left and posterior, RAS toward
right and anterior; both count toward superior. Neither is guessed: a file states its space, or the case does.

The command line reads the names of spaces and units from here, so numpy is not imported.
"""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING

from puncture_twin.planning.base.errors import refuse

if TYPE_CHECKING:
    from puncture_twin.planning.base.arrays import Floats


class Space(StrEnum):
    """The meaning of the three axes of a set of coordinates."""

    LPS = "LPS"
    RAS = "RAS"
    LOCAL = "local"


class Up(StrEnum):
    """Which axis of a mesh file is up, to the patient's head; the other two are as a turn about x leaves them."""

    Y = "y"
    Z = "z"


def to_lps(points: Floats, space: Space) -> Floats:
    """Coordinates (n, 3) of any unit in LPS; those of a local frame stay as they are, since such a frame is its own.

    RAS has x and y negated, which is its own inverse.
    """
    return points.astype(float) * ((-1.0, -1.0, 1.0) if space is Space.RAS else (1.0, 1.0, 1.0))


def point_text(point_ct: Floats, space: Space) -> str:
    """A point (3,), LPS (or local) mm, in the user's space, as text with its space."""
    return ", ".join(f"{one:.1f}" for one in to_lps(point_ct[None], space)[0]) + f" mm {space}"


def parse_space(text: str, *, where: str) -> Space:
    """The space that a text names, in upper or lower case. Raises InputError: It names none."""
    match = {space.lower(): space for space in Space}.get(text.strip().lower())
    return match or refuse(f"unknown space {text!r}", where, ", ".join(Space), "unknown_space")


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
    """The unit of length that a text names. Raises InputError: It names none."""
    if text.strip() not in tuple(Unit):
        refuse(f"unknown unit of length {text!r}", where, ", ".join(Unit), "unknown_unit")
    return Unit(text.strip())
