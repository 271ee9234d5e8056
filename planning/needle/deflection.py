"""How far a bevel can take a needle off its straight line, whatever side it points to and whatever it passes.

The bound is the path of a bevel that never turns, all the way in the stiffest tissue of the case: the stiffer the
tissue, the more a bevel steers. A stiff layer before soft ones can take it a little further: the allowance for that was
found on random orders, not proven.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.needle.bevel_path import STEP_MM, bevel_path
from puncture_twin.planning.needle.shaft import Shaft
from puncture_twin.planning.needle.tissue import Tissue

ALLOWANCE = 0.25
"""Added to the bevel's part: of 26,000 orders of layers, gaps without tissue among them and most of them found by
climbing from worse to worse, the worst went 18.7 % beyond the stiffest tissue alone, a thin layer before a gap."""

SHORTEST_BEND_MM = 2.5
"""1/lambda, over which a foundation bends a shaft. Some steps of an insertion; below it steps are too long: orders went
23.6 % beyond the stiffest alone at 2 mm, 44 % below 1 mm."""


@dataclass(frozen=True, eq=False)
class DeflectionBound:
    """The greatest deflection over depth.

    Attributes:
        depth_mm: Shape (m,), of the tip in the tissue, from 0, ascending.
        bevel_mm: Shape (m,), that the bevel causes, ascending.
        sag_mm: That the shaft's own weight causes, held horizontally.
    """

    depth_mm: Floats
    bevel_mm: Floats
    sag_mm: float

    def at(self, path_length: Floats | float) -> Floats:
        """For paths of these lengths, mm; that of the next depth of the table, and infinite beyond its end.

        Args:
            path_length: Any shape, mm; NaN where there is none, which stays NaN.
        """
        length = np.asarray(path_length, dtype=np.float64)
        row = np.searchsorted(self.depth_mm, np.nan_to_num(length))
        found = np.append(self.bevel_mm, np.inf)[np.minimum(row, len(self.bevel_mm))] + self.sag_mm
        return np.asarray(np.where(np.isnan(length), np.nan, found))


def deflection_bound(shaft: Shaft, alpha: float, tissues: Iterable[Tissue], longest_mm: float) -> DeflectionBound:
    """The bound of a needle in a case's tissues.

    Args:
        shaft: The needle's.
        alpha: Of its bevel, rad.
        tissues: All that it may pass.
        longest_mm: The longest path.
    """
    stiffest = max((tissue.stiffness_n_mm2 for tissue in tissues), default=0.0)
    count = int(np.ceil(longest_mm / STEP_MM))
    path = bevel_path(shaft, np.full(count, stiffest), np.full(count, alpha))
    return DeflectionBound(path.depth_mm, (1 + ALLOWANCE) * path.largest_mm, shaft.sag_mm)


def stiffest_resolved(shaft: Shaft) -> float:
    """Of tissues whose foundation bends a shaft over `SHORTEST_BEND_MM` or more, the stiffest, N/mm^2."""
    return 4 * shaft.bending_stiffness / SHORTEST_BEND_MM**4
