"""Weighted least squares: Gauss-Newton on the rotations' tangent space, damped where a step fails."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.geometry.gauss_newton import System, gauss_newton
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import Estimate, parameter_units
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import (
    Problem,
    Weights,
    linear_model,
    residual_weights,
    residuals,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.whitening import Whitening

MAX_STEPS = 50
"""A good start needs five; what has not settled after fifty does not."""

SMALL_STEP = 1e-7
"""A step whose largest part (rad, 100 mm) is smaller ends the refinement: it is off by less than 1e-5 mm."""


class Refined(NamedTuple):
    """Where the refinement ended."""

    estimate: Estimate
    iterations: int


def refine(
    problem: Problem, start: Estimate, tip_weights: Weights, direction_weights: Weights, *, max_steps: int = MAX_STEPS
) -> Refined:
    """The estimate of least weighted squares near a start; the pose covariances follow the estimate.

    Args:
        problem: What is estimated.
        start: Such as the closed form's.
        tip_weights: One per pose for its tip, shape (n,); a flag counts as 1 or 0.
        direction_weights: One per pose for its direction, shape (n,).
        max_steps: The most steps taken.
    """

    def linearised(estimate: Estimate) -> System[Estimate]:
        units = parameter_units(problem.active, estimate.scale)
        weights = residual_weights(problem, tip_weights, direction_weights)
        model = linear_model(problem, estimate)
        whitening = Whitening.of(model.sigma, model.shared, weights)
        white = whitening.residuals(model.residuals)
        return System(
            white,
            whitening.slopes(model.jacobian) * units,
            lambda near: float(np.sum(whitening.residuals(residuals(problem, near)) ** 2)),
        )

    fit = gauss_newton(
        start,
        linearised,
        lambda estimate, step: estimate.moved_by(problem.active, step),
        lambda _, step: bool(np.abs(step).max() < SMALL_STEP),
        max_steps,
    )
    return Refined(fit.estimate, fit.iterations)
