"""What is known where a fit ended: residuals, covariance, and the errors that all poses share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import (
    Problem,
    linear_model,
    residual_weights,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.whitening import whitener


class RobustFit(NamedTuple):
    """A fit, and which poses made it."""

    estimate: Estimate
    tip_kept: Bools
    """Shape (n,): the tip of this pose was used."""
    direction_kept: Bools
    """Shape (n,): its direction was used."""
    iterations: int


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


def weighed(problem: Problem, fit: RobustFit) -> Fitted:
    """A problem linearised at its fit, with the poses that made it."""
    weights = residual_weights(problem, fit.tip_kept, fit.direction_kept)
    r, J, sigma, N = linear_model(problem, fit.estimate)
    W, p = whitener(sigma, weights), J.shape[2]
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
