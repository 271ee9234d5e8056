"""One insertion of a needle that bends: where its bevel takes it, and what the arm feels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.needle.bevel_path import BevelPath, bevel_path, step_for
from puncture_twin.planning.needle.deflection import Bending
from puncture_twin.planning.needle.insertion_force import InsertionForce, insertion_force
from puncture_twin.planning.search.bending.path_layers import path_layers


class Insertion(NamedTuple):
    """A bevel that never turns, along one path; N and mm."""

    path: BevelPath
    force: InsertionForce
    buckling_free_n: float
    buckling_pinned_n: float

    @property
    def tip_mm(self) -> float:
        """By how much the tip misses a straight line, to the side to which the bevel points."""
        return float(self.path.cut_mm[-1])

    def lines(self, greatest_mm: float) -> list[str]:
        """For a person.

        Args:
            greatest_mm: The bound that the search keeps.
        """
        peak, free, pinned = self.force.peak_n, self.buckling_free_n, self.buckling_pinned_n
        kept = f"{greatest_mm:.2f} mm are kept as clearance"
        return [
            f"  needle bends   {self.tip_mm:8.2f} mm at the tip if its bevel never turns; {kept}",
            f"  axial force    {peak:8.2f} N at most; the shaft buckles at {free:.1f} N, pinned at {pinned:.1f} N",
        ]


def insertion_along(
    bending: Bending, anatomy: Anatomy, end_ct: Floats, outward_ct: Floats, path_length: float
) -> Insertion:
    """The insertion along one direction.

    Args:
        bending: Of the case.
        anatomy: Its structures.
        end_ct: Shape (3,), mm, where the path ends: the target.
        outward_ct: Shape (3,), unit.
        path_length: From there to the skin, mm.
    """
    layers = path_layers(bending, anatomy, end_ct, outward_ct, path_length)
    stiffest = max(layer.tissue.stiffness_n_mm2 for layer in layers)
    count = max(1, int(np.ceil(path_length / step_for(bending.shaft, stiffest))))
    middles = (np.arange(count) + 0.5) * path_length / count
    ends = np.array([layer.end_mm for layer in layers])
    at = np.minimum(np.searchsorted(ends, middles), len(layers) - 1)
    stiffness = np.array([layers[row].tissue.stiffness_n_mm2 for row in at])
    path = bevel_path(bending.shaft, stiffness, np.full(count, bending.alpha), path_length / count)
    shaft = bending.shaft
    return Insertion(path, insertion_force(layers), shaft.buckling_n(pinned=False), shaft.buckling_n(pinned=True))
