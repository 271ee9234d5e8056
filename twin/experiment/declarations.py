"""What somebody declares of the experiment's errors, and carton and touches drawn from it; mm and rad.

The pose of the carton does not matter: touches err alike in all directions, so that they are drawn in the CT's axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats

BED = 0
"""The CT's axis along the bed: the slices lie across it."""

PLANES = ((0, 1), (0, 2), (1, 2))
"""Pairs of CT axes that may be askew: the first along the second."""


@dataclass(frozen=True)
class Declaration:
    """Errors of one experiment.

    Attributes:
        name: What it is called in a table.
        slice_mm: Slice spacing: a uniform error of half of it each way along the bed.
        pixel_mm: The same across the bed.
        reading_mm: Standard deviation of a reading in the CT, per axis, besides.
        skew: Standard deviation of each plane's angle, rad: one draw for the whole CT.
        touch_mm: Standard deviation of a touch, per axis.
    """

    name: str
    slice_mm: float = 0.0
    pixel_mm: float = 0.0
    reading_mm: float = 0.0
    skew: float = 0.0
    touch_mm: float = 0.0

    def draw_carton(self, read: Floats, count: int, rng: np.random.Generator) -> Floats:
        """Where points (p, 3) that were read truly are, shape (count, p, 3)."""
        cells = rng.uniform(-0.5, 0.5, (count, *read.shape)) * self._cell()
        found = read + cells + rng.normal(0.0, 1.0, (count, *read.shape)) * self.reading_mm
        for first, second in PLANES:
            tangents = np.tan(rng.normal(0.0, 1.0, count) * self.skew)
            found[..., first] += tangents[:, None] * (read - read.mean(axis=0))[:, second]
        return np.asarray(found)

    def draw_touches(self, true: Floats, rng: np.random.Generator) -> Floats:
        """Touches of true points (..., 3), same shape."""
        return np.asarray(true + rng.normal(0.0, 1.0, true.shape) * self.touch_mm)

    def carton_covariance(self, read: Floats) -> Floats:
        """Of true points against their readings (p, 3), shape (3 p, 3 p), mm^2; skews to first order."""
        cov = np.diag(np.tile(self._cell() ** 2 / 12 + self.reading_mm**2, len(read)))
        for first, second in PLANES:
            moved = np.zeros(read.shape)
            moved[:, first] = (read - read.mean(axis=0))[:, second]
            cov += self.skew**2 * np.outer(moved.ravel(), moved.ravel())
        return np.asarray(cov)

    def _cell(self) -> Floats:
        cell = np.full(3, self.pixel_mm)
        cell[BED] = self.slice_mm
        return cell


AS_STATED = Declaration("as the paper states", slice_mm=5.0, pixel_mm=1.0, touch_mm=0.1)
"""Slices of 5 mm, pixels read to 1 mm, a control error of 0.1 mm."""

AS_FOUND = Declaration("as its touches show", reading_mm=0.5, skew=float(np.radians(2.0)), touch_mm=0.35)
"""A CT out of square, readings and touches as the distances between its points show (docs/reference/validation.md)."""
