"""A target whose numbers, read in the other space, lie in a likelier structure: LPS and RAS differ by two signs."""

from __future__ import annotations

from collections.abc import Iterator

from puncture_twin.planning.anatomy.anatomy import OWN_TARGET, Anatomy
from puncture_twin.planning.anatomy.likely_target import likely_target, slipped
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.containment import holds
from puncture_twin.planning.geometry.spaces import Space, point_text, to_lps


def space_warnings(case: Case, anatomy: Anatomy) -> tuple[str, ...]:
    """That the target lies in a lesion in the other space and in none here; or in an organ, and here in nothing.

    Nothing is refused: a lesion that nobody drew is a target as well, and its mirror image may lie in another one.
    """
    if case.space is Space.LOCAL:
        return ()
    here = list(_holders(anatomy, case.target_ct))
    other = list(_holders(anatomy, to_lps(case.target_ct[None], Space.RAS)[0]))
    if not slipped(likely_target(here), likely_target(other)):
        return ()
    name = max(other, key=lambda one: likely_target([one]))
    space = Space.RAS if case.space is Space.LPS else Space.LPS
    place = "in no structure" if not here else f"in {', '.join(here)}"
    return (
        f"the target ({point_text(case.target_ct, case.space)}) lies {place}; read in {space} the same numbers lie in "
        f"'{name}': is it stated in the right space?",
    )


def _holders(anatomy: Anatomy, point_ct: Floats) -> Iterator[str]:
    """The names of the structures that hold a point (3,), LPS mm; the target's own ball is none."""
    for structure in anatomy.structures:
        if structure.source != OWN_TARGET and holds(structure.mesh, point_ct):
            yield structure.name
