"""How far a bevel can take a needle off its straight line, whatever side it points to and whatever it passes.

The bound is the path of a bevel that never turns, all the way in the stiffest tissue of the case: the stiffer the
tissue, the more a bevel steers. A stiff layer before soft ones can take it further: the allowance for that was found by
search, not proven (what is proven of every order is several times as wide: docs/concepts/needle-and-tissue.md). Which
needle it is does not matter for that search: with lengths over 1/lambda, only the shaft's own and the layers' are left.
In given layers the path is linear in alpha, and a bevel that never turns goes furthest.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.formats.labels.naming import ByName
from puncture_twin.planning.needle.bevel_path import bevel_path, step_for
from puncture_twin.planning.needle.shaft import Shaft
from puncture_twin.planning.needle.tissue import Tissue

ALLOWANCE = 0.25
"""Added to the bevel's part. Tested, not proven: the worst order of layers is a thin stiff one before a gap, the worse
the more slender the shaft is. With lambda L the shaft's length over 1/lambda it goes 8 % beyond the stiffest tissue
alone at 40, 14 % at 80, 19 % at 150 and 27 % at 400; the step adds 1.5 % (3 % at first)."""

SHORTEST_BEND_MM = 2.5
"""1/lambda, over which a foundation bends a shaft: no tissue bends a needle within less, that a case was made for."""

MOST_SLENDER = 150.0
"""Length of a shaft over 1/lambda: beyond, the allowance does not hold."""


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
    step = step_for(shaft, stiffest)
    count = int(np.ceil(longest_mm / step))
    path = bevel_path(shaft, np.full(count, stiffest), np.full(count, alpha), step)
    return DeflectionBound(path.depth_mm, (1 + ALLOWANCE) * path.largest_mm, shaft.sag_mm)


def shortest_bend(shaft: Shaft) -> float:
    """The least 1/lambda, mm, for which the bound of a shaft holds."""
    return max(SHORTEST_BEND_MM, shaft.length_mm / MOST_SLENDER)


def stiffest_resolved(shaft: Shaft) -> float:
    """Of tissues whose foundation bends a shaft over `shortest_bend` or more, the stiffest, N/mm^2."""
    return 4 * shaft.bending_stiffness / shortest_bend(shaft) ** 4


@dataclass(frozen=True)
class Bending:
    """A needle with a bevel, and the tissues by the names of their structures.

    Attributes:
        shaft: From the holder to the tip.
        alpha: By which the bevel's cut leaves the shaft's direction, rad.
        tissues: The pattern ``*`` is all that no structure names.
    """

    shaft: Shaft
    alpha: float
    tissues: ByName[Tissue]

    def bound(self, longest_mm: float) -> DeflectionBound:
        """How far it may bend, on paths up to a length, mm."""
        return deflection_bound(self.shaft, self.alpha, self.tissues.of_pattern.values(), longest_mm)
