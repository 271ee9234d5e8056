"""Weighted least squares: the estimate, and what is known where it ends.

Gauss-Newton on the rotations' tangent space, damped where a step fails.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.gauss_newton import System, gauss_newton
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import N_PARAMETERS, Estimate, parameter_units
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals import Problem, linear_model, residuals
from puncture_twin.twin.guidance.ultrasound.axp_ybq.whitening import Whitening, whitener

MAX_STEPS = 50
"""A good start needs five; what has not settled after fifty does not."""

SMALL_STEP = 1e-7
"""A step whose largest part (rad, 100 mm) is smaller ends the refinement: it is off by less than 1e-5 mm."""


class Refined(NamedTuple):
    """Where the refinement ended."""

    estimate: Estimate
    iterations: int


def refine(problem: Problem, start: Estimate, weights: Floats, *, max_steps: int = MAX_STEPS) -> Refined:
    """The estimate of least weighted squares near a start; the pose covariances follow the estimate.

    Args:
        problem: What is estimated.
        start: Such as the closed form's.
        weights: One per residual, shape (n, k).
        max_steps: The most steps taken.
    """

    def linearised(estimate: Estimate) -> System[Estimate]:
        model = linear_model(problem, estimate)
        whitening = Whitening.of(model.sigma, model.shared, weights)
        units = parameter_units(problem.active, estimate.scale)

        def cost(near: Estimate) -> float:
            return float(np.sum(whitening.residuals(residuals(problem, near)) ** 2))

        return System(whitening.residuals(model.residuals), whitening.slopes(model.jacobian) * units, cost)

    def moved(estimate: Estimate, step: Floats) -> Estimate:
        return estimate.moved(_full(problem.active, parameter_units(problem.active, estimate.scale) * step))

    def arrived(_: System[Estimate], step: Floats) -> bool:
        return bool(np.abs(step).max() < SMALL_STEP)

    fit = gauss_newton(start, linearised, moved, arrived, max_steps)
    return Refined(fit.estimate, fit.iterations)


def _full(active: NDArray[np.int_], step: Floats) -> Floats:
    full = np.zeros(N_PARAMETERS)
    full[active] = step
    return full


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


def fitted(problem: Problem, estimate: Estimate, weights: Floats) -> Fitted:
    """Linearise a problem at its fit; the arguments are those of `refine`."""
    r, J, sigma, N = linear_model(problem, estimate)
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
