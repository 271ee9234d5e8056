"""P(sum lambda_i z_i^2 < x) of three standard normals, by Ruben's series (Ann. Math. Stat. 33, 1962).

With beta = min lambda and gamma_i = 1 - beta / lambda_i, P = sum_k c_k F_{3+2k}(x / beta), F the chi-squared
distribution. The weights' generating function C(t) = prod_i sqrt(beta / lambda_i) (1 - gamma_i t)^(-1/2) satisfies D
C' = -D' C / 2 with D = prod_i (1 - gamma_i t), of which one gamma is 0; hence (k+1) c_{k+1} = e1 (k + 1/2) c_k - e2 k
c_{k-1}, with e1 and e2 the sum and product of the other two gammas.
"""

from __future__ import annotations

import math

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb

SERIES_END = 1e-8
"""The series stops where what is left of its weights, which add up to 1, is smaller."""

MOST_TERMS = 20_000
"""Enough for standard deviations of a ratio of 30; what is left then is not counted, so that P is never too large."""


def chance_within(eigenvalues: Floats, radii: Floats) -> Floats:
    """The chance that a normal error stays within a radius.

    Args:
        eigenvalues: Shape (n, 3), of the covariance, mm^2, all above 0.
        radii: Shape (n, m), mm.

    Returns:
        Shape (n, m).
    """
    chances = np.empty(radii.shape)
    _ruben(np.sort(eigenvalues, axis=1), np.ascontiguousarray(radii, dtype=np.float64) ** 2, chances)
    return chances


@nb.njit(cache=True)
def _ruben(values, squares, chances):  # type: ignore[no-untyped-def]  # numba infers
    for row in range(len(values)):
        beta, mid, high = values[row]
        g1, g2 = 1.0 - beta / mid, 1.0 - beta / high
        start = math.sqrt(beta / mid * beta / high)
        for column in range(squares.shape[1]):
            chances[row, column] = _series(start, g1 + g2, g1 * g2, squares[row, column] / beta)


@nb.njit(cache=True)
def _series(weight, e1, e2, x):  # type: ignore[no-untyped-def]
    """Sum c_k F_{3+2k}(x), with F_{nu+2}(x) = F_nu(x) - (x/2)^(nu/2) exp(-x/2) / Gamma(nu/2 + 1)."""
    half = 0.5 * x
    if half <= 0.0:
        return 0.0
    before, left, total = 0.0, 1.0, 0.0
    F = math.erf(math.sqrt(half)) - math.sqrt(4.0 * half / math.pi) * math.exp(-half)
    log_step = 1.5 * math.log(half) - half - math.lgamma(2.5)
    for k in range(MOST_TERMS):
        total += weight * F
        left -= weight
        if left < SERIES_END or F <= 0.0:
            break
        F = max(F - math.exp(log_step), 0.0)
        log_step += math.log(half) - math.log(k + 2.5)
        weight, before = (e1 * (k + 0.5) * weight - e2 * k * before) / (k + 1.0), weight
    return min(max(total, 0.0), 1.0)
