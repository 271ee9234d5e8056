"""The shaft of a needle: gauges, stiffness, sag and the load at which it buckles. N and mm.

Closed forms of Euler and Bernoulli, as in any handbook (Young and Budynas, Roark's Formulas for Stress and Strain).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

STEEL_GPA = 200.0
"""Young's modulus of the austenitic steels of which needles are drawn: 193 to 200."""

STEEL_N_MM3 = 7.93e-6 * 9.81
"""Weight of such steel by volume: 7.93 g/cm^3."""

FREE_TIP, PINNED_TIP = np.pi**2 / 4, 20.1907
"""Euler's load times L^2 / EI of a clamped column with a free, and with a pinned end: the least root of tan x = x."""


class Gauge(NamedTuple):
    """Nominal diameters of a regular-wall needle, mm."""

    outer_mm: float
    inner_mm: float


GAUGES: Mapping[int, Gauge] = MappingProxyType(
    {
        10: Gauge(3.404, 2.692),
        11: Gauge(3.048, 2.388),
        12: Gauge(2.769, 2.159),
        13: Gauge(2.413, 1.803),
        14: Gauge(2.108, 1.600),
        15: Gauge(1.829, 1.372),
        16: Gauge(1.651, 1.194),
        17: Gauge(1.473, 1.067),
        18: Gauge(1.270, 0.838),
        19: Gauge(1.067, 0.686),
        20: Gauge(0.908, 0.603),
        21: Gauge(0.819, 0.514),
        22: Gauge(0.718, 0.413),
        23: Gauge(0.641, 0.337),
        24: Gauge(0.565, 0.311),
        25: Gauge(0.514, 0.260),
    }
)
"""The usual chart of nominal diameters of regular-wall needles."""


@dataclass(frozen=True)
class Shaft:
    """A straight round shaft, clamped at its holder.

    Attributes:
        length_mm: From the holder to the tip.
        outer_mm: Diameter.
        inner_mm: Of the bore; 0 for a solid shaft.
        modulus_gpa: Young's.
    """

    length_mm: float
    outer_mm: float
    inner_mm: float = 0.0
    modulus_gpa: float = STEEL_GPA

    @property
    def bending_stiffness(self) -> float:
        """EI, N mm^2, with I = pi (D^4 - d^4) / 64."""
        return self.modulus_gpa * 1e3 * np.pi * (self.outer_mm**4 - self.inner_mm**4) / 64

    @property
    def tip_stiffness_n_mm(self) -> float:
        """Lateral force at the free tip over its deflection: 3 EI / L^3."""
        return 3 * self.bending_stiffness / self.length_mm**3

    @property
    def sag_mm(self) -> float:
        """Of the free tip of a horizontal steel shaft: q L^4 / 8 EI, q its weight by length."""
        weight = STEEL_N_MM3 * np.pi * (self.outer_mm**2 - self.inner_mm**2) / 4
        return weight * self.length_mm**4 / (8 * self.bending_stiffness)

    def buckling_n(self, *, pinned: bool) -> float:
        """Axial load at which the shaft gives way: Euler's, its tip free, or pinned in the skin."""
        return (PINNED_TIP if pinned else FREE_TIP) * self.bending_stiffness / self.length_mm**2
