"""The breathing that a case declares: amplitude, direction, gate, and the weight by which each structure follows.

Everything moves along one line, structure i by s w_i b, with s the position in the breath, b the amplitude and w_i its
weight; the target's is 1. Nothing deforms, and in and out pass the same places. The position over time follows Lujan,
Larsen, Balter and Ten Haken, Med. Phys. 26 (1999), 715-720:

    z(t) = z0 - b cos^2n(pi t / T - phi)

z0 is the place at full exhale, T the period. With phi = pi/2 the period begins at exhale, and the
position s = (z0 - z) / b runs from 0 (exhale) to 1 (full inhale): s(t) = sin^2n(pi t / T).
"""

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats, read_only
from puncture_twin.planning.formats.labels.naming import ByName


@dataclass(frozen=True, eq=False)
class Breathing:
    """The breathing that a case declares; mm."""

    amplitude_mm: float  # b, of the target, from exhale to full inhale
    direction_ct: Floats  # shape (3,), unit: whereto inhaling moves it
    weights: ByName[float]
    phases: int
    exponent: int
    scanned_at: float  # the position s in which the CT shows the body
    gate: float | None  # the needle goes in while s is at most this; None for any time

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction_ct", read_only(self.direction_ct))

    @property
    def positions(self) -> Floats:
        """All positions s that are checked, ascending, shape (m,): the phases', and the gate itself."""
        of_phases = positions(self.phases, self.exponent)
        return of_phases if self.gate is None else np.union1d(of_phases, [self.gate])

    @property
    def in_window(self) -> Bools:
        """Which of `positions` lie in the gate's window, shape (m,)."""
        s = self.positions
        return np.asarray(s <= (1.0 if self.gate is None else self.gate))

    def moved_ct(self, s: float, weight: float = 1.0) -> Floats:
        """Displacement at a position s, times a weight, from where the CT shows it; shape (3,), mm."""
        return np.asarray((s - self.scanned_at) * weight * self.amplitude_mm * self.direction_ct)

    @property
    def spread_ct(self) -> Floats:
        """Mean and standard deviation of the target's displacement in the gate's window, along its line, (3, 2), mm."""
        gate = 1.0 if self.gate is None else self.gate
        about_0, about_1 = (mean_square_within(gate, self.exponent, about) for about in (0.0, 1.0))
        mean = (1.0 + about_0 - about_1) / 2.0
        both = [mean - self.scanned_at, np.sqrt(max(about_0 - mean**2, 0.0))]
        return np.asarray(self.amplitude_mm * np.outer(self.direction_ct, both))

    def phase_text(self, s: float) -> str:
        """A position of the breath, in words."""
        return f"s = {s:.2f}, {s * self.amplitude_mm:.1f} mm from exhale"

    @property
    def whole(self) -> bool:
        """Whether `positions` reach full inhale, or nothing moves: one phase alone says nothing of the others."""
        return self.amplitude_mm == 0 or bool(self.positions[-1] >= 1.0)

    @property
    def window_text(self) -> str:
        """When a safe candidate is safe, in words; never that a needle may stay while the patient breathes."""
        if self.gate is None and not self.whole:
            return "at exhale, if inserted at exhale; no other phase was checked"
        if self.gate is None:
            return "at each phase if inserted at that phase"
        return f"when gated to this window (s <= {self.gate:g})"


SAME = 12
"""Digits to which two positions count as one: breathing in and out pass the same places, but for rounding."""


def positions(phases: int, exponent: int) -> Floats:
    """The distinct positions of so many phases of a period, evenly spaced in time from exhale on; ascending, in 0..1.

    An even number holds full inhale.

    >>> positions(8, 2).round(3).tolist()
    [0.0, 0.021, 0.25, 0.729, 1.0]
    """
    s = np.sin(np.pi * np.arange(phases) / phases) ** (2 * exponent)
    return np.unique(np.round(s, SAME))


def fraction_within(position: float, exponent: int) -> float:
    """Fraction of the time that the breath is at this position or nearer to exhale: 2/pi arcsin(s^(1/2n))."""
    return float(2 / np.pi * np.arcsin(np.clip(position, 0.0, 1.0) ** (1 / (2 * exponent))))


def position_at(fraction: Floats, position: float, exponent: int) -> Floats:
    """Positions s of the breath at fractions of the time that it is at a position, the gate, or nearer to exhale.

    >>> position_at(np.array([0.0, 1.0]), 0.25, 4).round(12).tolist()
    [0.0, 0.25]
    """
    end = np.arcsin(np.clip(position, 0.0, 1.0) ** (1 / (2 * exponent)))
    return np.asarray(np.sin(end * fraction) ** (2 * exponent))


def mean_square_within(position: float, exponent: int, about: float) -> float:
    """Mean of (s - about)^2 over the time that the breath is at this position or nearer to exhale.

    Without a gate it is C(4n, 2n) / 2^4n - 2 about C(2n, n) / 2^2n + about^2, of the powers of a sine.

    >>> round(12 * mean_square_within(1.0, 4, 0.0) ** 0.5, 1)
    5.3
    """
    end = np.arcsin(np.clip(position, 0.0, 1.0) ** (1 / (2 * exponent)))
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    s = np.sin(end * (nodes + 1) / 2) ** (2 * exponent)  # nodes -1..1 to angles 0..end
    return float(np.sum(weights * (s - about) ** 2) / 2)


NODES = 32
"""Nodes of Gauss and Legendre: powers of a sine up to the 24th are exact to 1e-12 over a quarter period."""
