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


def mean_square_within(position: float, exponent: int, about: float) -> float:
    """Mean of (s - about)^2 over the time that the breath is at this position or nearer to exhale.

    Without a gate it is C(4n, 2n) / 2^4n - 2 about C(2n, n) / 2^2n + about^2, of the powers of a sine.

    Args:
        position: s, 0 at exhale, 1 at full inhale.
        exponent: n of the curve.
        about: s of the place that is compared with.

    >>> round(12 * mean_square_within(1.0, 4, 0.0) ** 0.5, 1)
    5.3
    """
    end = np.arcsin(np.clip(position, 0.0, 1.0) ** (1 / (2 * exponent)))
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    s = np.sin(end * (nodes + 1) / 2) ** (2 * exponent)
    return float(np.sum(weights * (s - about) ** 2) / 2)


NODES = 32
"""Of Gauss and Legendre: powers of a sine up to the 24th are exact to 1e-12 over a quarter of its period."""
