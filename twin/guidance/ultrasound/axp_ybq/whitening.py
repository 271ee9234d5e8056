"""Residuals in units of their standard deviation, with errors of the arms that all poses share.

Each pose's own noise Omega_i is whitened alone. Errors that all poses share (N per standard deviation of each) couple
the poses: the residuals' covariance is C = Omega + N N^T, and with S = Omega^-1/2 N

    C^-1/2 = (I + S S^T)^-1/2 Omega^-1/2,   (I + S S^T)^-1/2 = I - S V diag(1 / (s (s + 1))) V^T S^T,   s^2 = 1 + d^2,

where S^T S = V diag(d^2) V^T. The same estimate comes from taking the shared errors as unknowns with a prior.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals import (
    Problem,
    linearise,
    problem_covariances,
    residual_weights,
    shared_slopes,
)

LEAST_WEIGHT = 1e-12
"""A pose that is set aside keeps this weight: its residual's standard deviation is a million times as large."""


def whitener(sigma: Floats, weights: Floats) -> Floats:
    """W with W^T W the inverse covariance, each pose's times its weight; shape (n, k, k).

    Args:
        sigma: Shape (n, k, k).
        weights: Shape (n, k): one per residual; 0 sets it aside.
    """
    spread = 1.0 / np.sqrt(np.maximum(weights, LEAST_WEIGHT))
    scaled = sigma * spread[:, :, None] * spread[:, None, :]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(scaled)))


class Whitening(NamedTuple):
    """C^-1/2, applied to residuals and slopes."""

    own: Floats
    """Of each pose alone, shape (n, k, k)."""
    shared: Floats | None
    """S, shape (n k, m); None where nothing is shared."""
    inner: Floats
    """V diag(1 / (s (s + 1))) V^T, shape (m, m)."""

    @classmethod
    def of(cls, problem: Problem, estimate: Estimate, weights: Floats) -> Whitening:
        """At an estimate, with one weight per residual (n, k)."""
        own = whitener(problem_covariances(problem, estimate), weights)
        slopes = shared_slopes(problem, estimate)
        if slopes is None:
            return cls(own, None, np.zeros((0, 0)))
        shared = (own @ slopes).reshape(-1, slopes.shape[2])
        squared, V = np.linalg.eigh(shared.T @ shared)
        s = np.sqrt(1.0 + np.maximum(squared, 0.0))
        return cls(own, shared, (V / (s * (s + 1.0))) @ V.T)

    def residuals(self, r: Floats) -> Floats:
        """Of residuals (n, k): shape (n k,)."""
        return self._coupled((self.own @ r[:, :, None]).reshape(-1))

    def slopes(self, J: Floats) -> Floats:
        """Of slopes (n, k, p): shape (n k, p)."""
        return self._coupled((self.own @ J).reshape(-1, J.shape[2]))

    def _coupled(self, x: Floats) -> Floats:
        if self.shared is None:
            return x
        return np.asarray(x - self.shared @ (self.inner @ (self.shared.T @ x)))


class Fitted(NamedTuple):
    """A problem linearised at its fit; errors that the poses share stand behind the free parameters as unknowns."""

    residuals: Floats
    """Shape (n, k), without what the shared errors explain."""
    jacobian: Floats
    """Shape (n, k, p + m): by the free parameters, then by the shared errors, each in its standard deviation."""
    sigma: Floats
    """Expected covariance of each pose's own noise, shape (n, k, k)."""
    white: Floats
    """The residuals of the poses that were used, over their spread, shape (n, k)."""
    covariance: Floats
    """Of the free parameters and the shared errors together, shape (p + m, p + m)."""
    shared: Floats
    """The shared errors' posterior mean, in standard deviations, shape (m,)."""
    whitener: Floats
    """Of each pose's own noise, shape (n, k, k)."""

    @property
    def chi_squared(self) -> float:
        """r^T C^-1 r: the residuals' squares, and what the shared errors cost."""
        return float(np.sum(self.white**2) + self.shared @ self.shared)


def fitted(problem: Problem, estimate: Estimate, tip_kept: Bools, direction_kept: Bools) -> Fitted:
    """Linearise a problem at its fit; the tips and directions that were used are kept, each shape (n,)."""
    r, J = linearise(problem, estimate)
    sigma = problem_covariances(problem, estimate)
    W = whitener(sigma, residual_weights(problem, tip_kept, direction_kept))
    N = shared_slopes(problem, estimate)
    p = J.shape[2]
    if N is not None:
        J = np.concatenate([J, N], axis=2)
    slopes = (W @ J).reshape(-1, J.shape[2])
    information = slopes.T @ slopes
    information[p:, p:] += np.eye(J.shape[2] - p)
    C = np.asarray(np.linalg.pinv(information, hermitian=True), dtype=np.float64)
    shared = np.zeros(0)
    if N is not None:
        shared = -C[p:] @ (slopes.T @ (W @ r[:, :, None]).reshape(-1))
        r = r + N @ shared
    return Fitted(r, J, sigma, (W @ r[:, :, None])[:, :, 0], C, shared, W)
