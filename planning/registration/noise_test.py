"""Does the declaration hold? The chi-squared test of the weighted residuals, and the scale that they give instead."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, chdtri, fdtri

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.registration.fits.fit_map import least_squares_map
from puncture_twin.planning.registration.residual_test import DOUBT, INTERVAL, Interval

WARNED = 0.01
"""Residuals that the declared errors exceed once in 100 registrations: it is warned, and the errors are scaled."""


@dataclass(frozen=True)
class NoiseTest:
    """The residuals of a weighted fit against the declared errors.

    Attributes:
        count: Markers, N >= 3.
        chi_squared: r' C^-1 r of the weighted residuals: chi-squared with 3 N - 6 degrees where the declaration holds.
        found: Whether the declaration gives the errors' shape alone, and the residuals their size.
    """

    count: int
    chi_squared: float
    found: bool = False

    @property
    def freedom(self) -> int:
        """Degrees of freedom, nu = 3 N - 6."""
        return 3 * self.count - 6

    @property
    def probability(self) -> float:
        """Of residuals as large as these, if the declaration holds."""
        return float(chdtrc(self.freedom, self.chi_squared))

    @property
    def agrees(self) -> bool:
        """Whether the residuals agree with the declaration, or nothing was declared about their size."""
        return self.found or self.probability >= WARNED

    @property
    def explained(self) -> bool:
        """Whether a registration with such residuals is taken at all without the case's consent."""
        return self.found or self.probability >= DOUBT

    @property
    def estimate(self) -> float:
        """s, the size of the errors by the residuals over the declared one."""
        return float(np.sqrt(self.chi_squared / self.freedom))

    @property
    def interval(self) -> Interval:
        """The 95 % interval of the true size over the declared one: nu s^2 over chi-squared."""
        tail = (1 - INTERVAL) / 2
        low, high = (float(np.sqrt(self.chi_squared / chdtri(self.freedom, p))) for p in (tail, 1 - tail))
        return Interval(low, high)

    @property
    def scale(self) -> float:
        """By which the declared deviations are multiplied: 1 where the declaration holds."""
        return self.estimate if self.found or not self.agrees else 1.0

    @property
    def scaled(self) -> bool:
        """Whether the size is that of the residuals, so that chances follow Student's t and regions Fisher's F."""
        return self.found or not self.agrees

    @property
    def region_factor(self) -> float:
        """The k of the 95 % region d' Sigma^-1 d <= k^2 in three dimensions, Sigma scaled: sqrt(chi2) or sqrt(3 F)."""
        if self.scaled:
            return float(np.sqrt(3 * fdtri(3, self.freedom, INTERVAL)))
        return float(np.sqrt(chdtri(3, 1 - INTERVAL)))

    def text(self) -> str:
        """What the test found, in one sentence."""
        low, high = self.interval
        size = f"the residuals say {self.estimate:.2f} times the declared errors (95 %: {low:.2f} to {high:.2f})"
        if self.found:
            return f"noise found: {size}"
        verdict = "agree with" if self.agrees else "do not agree with"
        return (
            f"residuals {verdict} the declared errors (chi-squared {self.chi_squared:.1f}, {self.freedom} degrees of "
            f"freedom, p {self.probability:.2g}); {size}"
        )


def noise_test(residuals: Floats, cov: Floats, A: Floats, *, found: bool = False) -> NoiseTest:
    """Test the stacked residuals (3 N,) of any fit, whose design is A (3 N, 6), against their covariance (3 N, 3 N).

    They are first freed of what the best weights would have fitted: r = M z, M = I - A (A' C^-1 A)^-1 A' C^-1.
    """
    weights = np.asarray(np.linalg.inv(cov), dtype=np.float64)
    free = residuals - A @ (least_squares_map(A, weights) @ residuals)
    return NoiseTest(len(residuals) // 3, float(free @ weights @ free), found)
