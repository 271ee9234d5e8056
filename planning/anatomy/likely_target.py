"""How likely what holds a point is to be a target: by that the wrong one of two readings of a point is found."""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum

from puncture_twin.planning.anatomy.default_roles import LESION, NEVER_CROSSED, default_role, never_crossed


class Likely(IntEnum):
    """How likely a structure is to be a target, the least first."""

    NOTHING = 0
    """No structure at all: fat, or what nobody drew."""
    DANGER = 1
    """A large vessel, a nerve, the heart: no usual target."""
    OTHER = 2
    """Anything else, such as a bone, a muscle, or a name that nobody knows."""
    ORGAN = 3
    """An organ that the table of default roles knows and that is avoided: a lesion may lie in it."""
    LESION = 4


def likely_target(names: Iterable[str]) -> Likely:
    """Of the structures that hold a point, the likeliest target."""
    return max((_of(name) for name in names), default=Likely.NOTHING)


def slipped(here: Likely, other: Likely) -> bool:
    """Whether a point is to be doubted because the same numbers, read in another space, lie in what is likelier."""
    return here < other is Likely.LESION or (here is Likely.NOTHING and other >= Likely.ORGAN)


def _of(name: str) -> Likely:
    line = default_role(name, "other")
    if line == LESION:
        return Likely.LESION if never_crossed(name) is None else Likely.DANGER
    if line is None or line.kind != "avoid":
        return Likely.OTHER
    return Likely.DANGER if line.group in NEVER_CROSSED else Likely.ORGAN
