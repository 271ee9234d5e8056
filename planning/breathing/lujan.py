"""The breath as a curve: Lujan, Larsen, Balter and Ten Haken, Med. Phys. 26 (1999), 715-720.

    z(t) = z0 - b cos^2n(pi t / T - phi)

z0 is the place at full exhale, b the amplitude, T the period. With phi = pi/2 the period begins at exhale, and the
position s = (z0 - z) / b runs from 0 (exhale) to 1 (full inhale): s(t) = sin^2n(pi t / T).
"""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats

SAME = 12
"""Digits to which two positions are one: breathing in and out pass the same places, but for rounding."""


def positions(phases: int, exponent: int) -> Floats:
    """The distinct positions of so many phases, evenly spaced in time from exhale on; ascending, each in 0..1.

    Args:
        phases: Of one period. An even number holds full inhale.
        exponent: n of the curve.

    >>> positions(8, 2).round(3).tolist()
    [0.0, 0.021, 0.25, 0.729, 1.0]
    """
    s = np.sin(np.pi * np.arange(phases) / phases) ** (2 * exponent)
    return np.unique(np.round(s, SAME))


def fraction_within(position: float, exponent: int) -> float:
    """Fraction of the time that the breath is at this position or nearer to exhale: 2/pi arcsin(s^(1/2n)).

    Args:
        position: s, 0 at exhale, 1 at full inhale.
        exponent: n of the curve.
    """
    return float(2 / np.pi * np.arcsin(np.clip(position, 0.0, 1.0) ** (1 / (2 * exponent))))
