"""How well a set of markers determines a registration at a point: expected error, and the three flags of a weak set."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from puncture_twin.planning.base.arrays import Floats

WEAK_SPREAD = 0.2
"""Conditioning flag: s2/s1 below it (spec: trips on the paper's A-C-D only)."""

WEAK_ALTITUDE_MM = 30.0
"""Conditioning flag: least altitude of the widest triangle below it."""

WEAK_LEVERAGE = 3.0
"""Conditioning flag: TRE(target)/FLE above it."""


@dataclass(frozen=True)
class Conditioning:
    """How well a marker set determines the pose at the target.

    Attributes:
        spread_ratio: s2/s1, singular values of the centred markers.
        altitude_mm: Least altitude of the widest triangle of markers.
        leverage: Expected TRE at the target over FLE.
        flags: The weak points in words; empty for a good set.
    """

    spread_ratio: float
    altitude_mm: float
    leverage: float
    flags: tuple[str, ...]


def leverage(markers: Floats, points: Floats) -> Floats:
    """TRE over FLE at points (n, 3), shape (n,) (Fitzpatrick, West, Maurer 1998, Eq. 46).

    <TRE^2> = <FLE^2>/N (1 + 1/3 sum_k d_k^2/f_k^2), d_k the distance of the point from principal axis k of the
    markers and f_k the markers' rms distance from it.
    """
    center = markers.mean(axis=0)
    _, _, axes = np.linalg.svd(markers - center)
    from_axes = _squared_distances(np.atleast_2d(points) - center, axes)
    spread = _squared_distances(markers - center, axes).mean(axis=0)
    return np.asarray(np.sqrt((1 + (from_axes / spread).sum(axis=1) / 3) / len(markers)))


def _squared_distances(points: Floats, axes: Floats) -> Floats:
    """Squared distance of points (n, 3) from each of three axes through the origin, shape (n, 3)."""
    along = (points @ axes.T) ** 2
    return along.sum(axis=1, keepdims=True) - along


def conditioning(markers: Floats, target: Floats) -> Conditioning:
    """The three flags of a marker set; thresholds are the module's constants."""
    values = np.linalg.svd(markers - markers.mean(axis=0), compute_uv=False)
    ratio = float(values[1] / values[0])
    altitude = max(_least_altitude(markers[list(three)]) for three in combinations(range(len(markers)), 3))
    lever = float(leverage(markers, target)[0])
    flags = []
    if ratio < WEAK_SPREAD:
        flags.append(f"markers lie almost on a line (s2/s1 {ratio:.2f} < {WEAK_SPREAD})")
    if altitude < WEAK_ALTITUDE_MM:
        flags.append(f"the widest marker triangle is flat (altitude {altitude:.0f} < {WEAK_ALTITUDE_MM:.0f} mm)")
    if lever > WEAK_LEVERAGE:
        flags.append(f"the target is far from the markers (TRE/FLE {lever:.1f} > {WEAK_LEVERAGE:.0f})")
    return Conditioning(ratio, altitude, lever, tuple(flags))


def _least_altitude(triangle: Floats) -> float:
    """Twice the area over the longest side."""
    sides = triangle - np.roll(triangle, 1, axis=0)
    longest = np.linalg.norm(sides, axis=1).max()
    return float(np.linalg.norm(np.cross(sides[0], sides[1])) / longest) if longest > 0 else 0.0
