"""One number that the paper's own points show: a skew of the CT's y against z, found from markers, tried on lesions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits.least_squares import fit_rigid, fit_triad
from puncture_twin.twin.experiment.printed import READ, SETUPS, TRIADS, rows_of

MARKERS, SETUP = "ABCDE", 1
"""From which the skew is found: the markers of the second setup, no lesion among them."""

WIDEST = 0.3
"""tan of 17 degrees: no scanner is farther out of square."""


@dataclass(frozen=True)
class LesionErrors:
    """What the paper's triads miss a lesion by, mm.

    Attributes:
        name: Lesion, markers and setup.
        as_read: As the paper prints it.
        square: With the skew taken off the CT's readings.
    """

    name: str
    as_read: float
    square: float


@dataclass(frozen=True)
class SkewFinding:
    """The skew, and what it does.

    Attributes:
        angle: rad, of y against z.
        lesions: Each lesion that the paper's triads reach for.
    """

    angle: float
    lesions: tuple[LesionErrors, ...]


def find_skew() -> SkewFinding:
    """Find the skew from the markers of setup 2 alone, and take it off before every triad of both setups."""
    names = rows_of(MARKERS)
    touched = _touched(SETUP)

    def squares(k: float) -> float:
        square = unskewed(READ, k)[names]
        return float(np.sum((apply(fit_rigid(square, touched[names]), square) - touched[names]) ** 2))

    k = float(minimize_scalar(squares, bounds=(-WIDEST, WIDEST), method="bounded", options={"xatol": 1e-9}).x)
    lesions = tuple(
        LesionErrors(
            f"{lesion} by {'-'.join(markers)}, setup {setup + 1}",
            _miss(READ, setup, markers, lesion),
            _miss(unskewed(READ, k), setup, markers, lesion),
        )
        for setup, markers, lesion in TRIADS
    )
    return SkewFinding(float(np.arctan(k)), lesions)


def unskewed(points: Floats, k: float) -> Floats:
    """Points (n, 3) with y moved by k along z, mm."""
    moved = points.copy()
    moved[:, 1] += k * points[:, 2]
    return moved


def _miss(read: Floats, setup: int, markers: str, lesion: str) -> float:
    touched, row = _touched(setup), rows_of(lesion)[0]
    T = fit_triad(read[rows_of(markers)], touched[rows_of(markers)])
    return float(np.linalg.norm(apply(T, read[row]) - touched[row]))


def _touched(setup: int) -> Floats:
    found = np.full(READ.shape, np.nan)
    for name, point in SETUPS[setup].items():
        found[rows_of(name)[0]] = point
    return found
