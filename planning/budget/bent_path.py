"""A needle that bends on one path through a case's tissues, and what another needle would do there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.skin_entry import skin_paths
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.needle.deflection import Bending
from puncture_twin.planning.needle.shaft import GAUGES, Shaft
from puncture_twin.planning.search.bending.insertion import insertion_along
from puncture_twin.planning.uncertainty.pose_error import Bend


@dataclass(frozen=True, eq=False)
class BentPath:
    """What bends a needle, and what it passes.

    Attributes:
        case: The case.
        anatomy: Its structures, whose tissues the path passes.
        outward_ct: Shape (3,), unit, from the target along the needle.
        path_length: Target to skin, mm.
        bending: Needle and tissues.
    """

    case: Case
    anatomy: Anatomy
    outward_ct: Floats
    path_length: float
    bending: Bending

    @cached_property
    def bend(self) -> Bend:
        """By how much, if its bevel never turns."""
        insertion = insertion_along(self.bending, self.anatomy, self.case.target_ct, self.outward_ct, self.path_length)
        return Bend(insertion.tip_mm, self.bending.shaft.length_mm)

    def with_shaft(self, shaft: Shaft) -> BentPath:
        """With another needle of the same bevel."""
        return replace(self, bending=replace(self.bending, shaft=shaft))

    def without_bevel(self) -> BentPath:
        """With a symmetric tip."""
        return replace(self, bending=replace(self.bending, alpha=0.0))


def bent_path(case: Case, anatomy: Anatomy, outward_ct: Floats) -> BentPath | None:
    """The path of one direction; None where the needle is straight, or the direction enters no skin.

    Args:
        case: The case.
        anatomy: Its structures.
        outward_ct: Shape (3,), unit.
    """
    if case.bending is None:
        return None
    paths = skin_paths(anatomy.skin, case.target_ct, outward_ct[None], case.needle.length_mm)
    length = float(paths.path_length[0])
    return BentPath(case, anatomy, outward_ct, length, case.bending) if np.isfinite(length) else None


def other_gauges(shaft: Shaft) -> dict[int, Shaft]:
    """The next finer gauge and the two next thicker ones, by their numbers; tubes beside a tube, rods beside a rod."""
    by_width = sorted(GAUGES, key=lambda number: GAUGES[number].outer_mm)
    finer = [number for number in by_width if GAUGES[number].outer_mm < shaft.outer_mm - SAME_MM]
    thicker = [number for number in by_width if GAUGES[number].outer_mm > shaft.outer_mm + SAME_MM]
    solid = shaft.inner_mm == 0.0
    return {
        number: replace(shaft, outer_mm=GAUGES[number].outer_mm, inner_mm=0.0 if solid else GAUGES[number].inner_mm)
        for number in (*finer[-1:], *thicker[:2])
    }


SAME_MM = 0.03
"""Between the diameters of one gauge, as a case may state them."""
