"""What a case declares of a needle that bends, and of the tissues that it passes."""

from __future__ import annotations

from dataclasses import dataclass

from puncture_twin.planning.formats.labels.by_name import ByName
from puncture_twin.planning.needle.deflection import DeflectionBound, deflection_bound
from puncture_twin.planning.needle.shaft import Shaft
from puncture_twin.planning.needle.tissue import Tissue


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
