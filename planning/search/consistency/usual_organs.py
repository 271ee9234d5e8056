"""The usual organs of the case's region that no structure names."""

from __future__ import annotations

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.regions import absent_organs
from puncture_twin.planning.case.case import Case


def region_warnings(case: Case, anatomy: Anatomy) -> tuple[str, ...]:
    """The usual organs of the case's region that nobody named: they count as free."""
    if case.region is None:
        return ()
    absent = absent_organs(case.region, [*(structure.name for structure in anatomy.structures), *anatomy.ignored])
    if not absent:
        return ()
    like = ", ".join(absent)
    return (f"region {case.region}: no structure is named like {like}; what has no structure counts as free",)
