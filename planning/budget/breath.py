"""What the breath adds to a needle's error: the target is not where the CT shows it while the needle goes in.

With s of the breath at the insertion, evenly drawn in time from those that the gate lets through, and s0 of the CT:

    Sigma = b^2 <(s - s0)^2> u u'

b the amplitude and u its direction. It is a mean square, not a variance: the mean of s - s0 is not 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.breathing.lujan import mean_square_within

GATES = (None, 0.5, 0.25, 0.1)
"""Of the needle that waits, by s; None waits for nothing."""


@dataclass(frozen=True, eq=False)
class Breath:
    """The breathing of a case, in its base frame.

    Attributes:
        breathing: As declared.
        R_base_ct: Shape (3, 3).
    """

    breathing: Breathing
    R_base_ct: Floats

    def mean_square_base(self) -> Floats:
        """Shape (3, 3), mm^2, of the target against where the CT shows it, base axes."""
        one = self.breathing
        moved = self.R_base_ct @ (one.amplitude_mm * one.direction_ct)
        gate = 1.0 if one.gate is None else one.gate
        return np.asarray(mean_square_within(gate, one.exponent, one.scanned_at) * np.outer(moved, moved))
