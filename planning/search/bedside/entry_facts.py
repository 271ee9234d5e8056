"""All that a person needs to find a path again at the patient: the one table that terminal, JSON and page show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.search.bedside.entry_place import EntryPlace, Landmark, entry_place
from puncture_twin.planning.search.bedside.needle_planes import NeedlePlanes, needle_planes


@dataclass(frozen=True, eq=False)
class EntryFacts:
    """One path from outside to the target, for whoever stands at the patient.

    Attributes:
        space: Of the case: what a person typed is answered in it.
        entry_mm: Shape (3,), the skin entry in that space, mm; NaN without one.
        place: Seen from the nearest marker, or from the target where the case has none; None without an entry.
        planes: Its angles in the scanner; None in a local space, which has no anatomy.
    """

    space: Space
    entry_mm: Floats
    place: EntryPlace | None
    planes: NeedlePlanes | None

    def rows(self) -> tuple[tuple[str, str], ...]:
        """What it is, and how a person reads it."""
        stated: list[tuple[str, str]] = []
        if self.place is not None:
            point = ", ".join(f"{mm:.1f}" for mm in self.entry_mm)
            stated = [("skin entry", f"({point}) mm {self.space}"), ("on the skin", self.place.text(self.space))]
        return (*stated, *(() if self.planes is None else self.planes.rows()))

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm and degrees; null where there is no number."""
        place = None
        if self.place is not None:
            x, y, z = self.place.offset_ct.tolist()
            names = ("x_mm", "y_mm", "z_mm") if self.space is Space.LOCAL else ("left_mm", "back_mm", "head_mm")
            place = {
                "of": self.place.landmark.name,
                **dict(zip(names, (x, y, z), strict=True)),
                "distance_mm": self.place.distance_mm,
                "text": self.place.text(self.space),
            }
        return {
            "space": str(self.space),
            "entry_mm": None if self.place is None else self.entry_mm.tolist(),
            "entry_from": place,
            "in_scanner": None if self.planes is None else self.planes.summary(),
        }


def entry_facts(case: Case, markers: Sequence[Landmark], entry_ct: Floats, outward_ct: Floats) -> EntryFacts:
    """Describe a path.

    Args:
        case: Its space and target.
        markers: Those of its registration; may be none.
        entry_ct: Shape (3,), mm; NaN without a skin entry.
        outward_ct: Shape (3,), unit, from the target outward.
    """
    landmarks = markers or (Landmark("the target", np.asarray(case.target_ct)),)
    planes = None if case.space is Space.LOCAL else needle_planes(outward_ct)
    entry_mm = to_lps(entry_ct[None], case.space)[0]  # the change of signs undoes itself
    return EntryFacts(case.space, entry_mm, entry_place(entry_ct, landmarks), planes)
