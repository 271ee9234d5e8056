"""Residuals in units of their standard deviation, with errors of the arms that all poses share.

Each pose's own noise Omega_i is whitened alone. Errors that all poses share (N per standard deviation of each) couple
the poses: the residuals' covariance is C = Omega + N N^T, and with S = Omega^-1/2 N

    C^-1/2 = (I + S S^T)^-1/2 Omega^-1/2,   (I + S S^T)^-1/2 = I - S V diag(1 / (s (s + 1))) V^T S^T,   s^2 = 1 + d^2,

where S^T S = V diag(d^2) V^T. The same estimate comes from taking the shared errors as unknowns with a prior.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats

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
    def of(cls, sigma: Floats, slopes: Floats | None, weights: Floats) -> Whitening:
        """C^-1/2 of poses with noise of their own and errors in common.

        Args:
            sigma: Covariance of each pose's own noise, shape (n, k, k).
            slopes: N: the residuals' derivative by what is shared, in standard deviations, shape (n, k, m); or None.
            weights: Shape (n, k): one per residual; 0 sets it aside.
        """
        own = whitener(sigma, weights)
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
