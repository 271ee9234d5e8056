"""One needle, and how it may be displaced."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
from scipy.special import chdtri

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.frames import frame_about
from puncture_twin.planning.geometry.rotations import skew

Problem = tuple[Floats, Floats, Floats, Floats, Floats, float, float]
"""Faces near a needle and spheres around them, its start and direction, its length and the threshold."""

FARTHEST = 5.0
"""Standard deviations that a line is walked to either side; a stretch that is open there goes on for ever."""

WIDEST = 4.0
"""Standard deviations across which a line may lie: what lies beyond has a chance of .003 and less to matter."""

SIZES = 16
"""Of chi-squared, at the middles of equal parts, where the errors' size is uncertain."""


@dataclass(frozen=True, eq=False)
class NeedleDoubt:
    """One needle, and how it may be displaced; CT frame, mm and rad.

    Attributes:
        origin: Shape (3,), the tip's own place, where the axis starts.
        outward: Shape (3,), unit.
        root: Shape (6, 5), B: shift and lean of each of five standard normals.
        surface_mm: Standard deviation of the surface, as a whole, of the structure that is asked about.
        freedom: Degrees of the errors' size where the residuals gave it.
    """

    origin: Floats
    outward: Floats
    root: Floats
    surface_mm: float
    freedom: int | None

    def reach(self, length: float, threshold: float) -> tuple[float, float]:
        """How near a face must be to matter, mm, at the tip and at the axis' other end: farther than any line leads."""
        tip, top, turn = self._widths(length)
        start, end = threshold + self._size * (self.surface_mm + tip), threshold + self._size * (self.surface_mm + top)
        return start, end + 0.5 * length * (self._size * turn) ** 2

    @cached_property
    def _size(self) -> float:
        """Standard deviations, and more than any line has."""
        return math.hypot(FARTHEST, WIDEST + 1.0) * (
            1.0 if self.freedom is None else float(error_sizes(self.freedom).max())
        )

    @cached_property
    def _widths(self) -> Callable[[float], tuple[float, float, float]]:
        """For an axis of a given length: how far tip (mm), other end (mm) and direction (rad) may lie off, at most."""
        shift, lean = self.root[:3], self.root[3:]
        tip, turn = float(np.linalg.norm(shift, 2)), float(np.linalg.norm(lean, 2))

        @cache  # many structures are measured from axes of one length
        def of(length: float) -> tuple[float, float, float]:
            return tip, float(np.linalg.norm(shift - length * skew(self.outward) @ lean, 2)), turn

        return of


def needle_doubt(
    origin: Floats, outward: Floats, cov_ct: Floats, surface_mm: float, freedom: int | None = None
) -> NeedleDoubt:
    """From Sigma6.

    Args:
        origin: Shape (3,), mm, the covariance's point of reference.
        outward: Shape (3,), unit.
        cov_ct: Shape (6, 6), CT axes.
        surface_mm: As there.
        freedom: As there.
    """
    across = frame_about(outward)[:, :2]
    keep = np.zeros((6, 5))
    keep[:3, :3], keep[3:, 3:] = np.eye(3), across
    values, axes = np.linalg.eigh(_balanced(keep.T @ cov_ct @ keep))
    root = keep @ (_scales(keep.T @ cov_ct @ keep)[:, None] * axes * np.sqrt(np.maximum(values, 0.0)))
    return NeedleDoubt(origin, outward, np.ascontiguousarray(root), surface_mm, freedom)


def _scales(cov: Floats) -> Floats:
    """Standard deviations; mm and rad differ by orders of magnitude."""
    return np.asarray(np.sqrt(np.maximum(np.diag(cov), 0.0)))


def _balanced(cov: Floats) -> Floats:
    """Correlations."""
    scale = np.where(_scales(cov) > 0, _scales(cov), 1.0)
    return np.asarray(cov / np.outer(scale, scale))


@cache
def error_sizes(freedom: int) -> Floats:
    """By how much the errors' true size may exceed the estimate: sqrt(nu / chi-squared) at equal chances."""
    return np.asarray(np.sqrt(freedom / chdtri(freedom, (np.arange(SIZES) + 0.5) / SIZES)))
