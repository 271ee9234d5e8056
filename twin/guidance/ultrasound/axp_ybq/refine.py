"""Gauss-Newton on the rotations' tangent space (spec 3, section 2), damped where a step fails."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.gauss_newton import System, gauss_newton
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import N_PARAMETERS, Estimate, parameter_units
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals import Problem, linearise, residuals
from puncture_twin.twin.guidance.ultrasound.axp_ybq.whitening import Whitening

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
        whitening = Whitening.of(problem, estimate, weights)
        r, J = linearise(problem, estimate)
        units = parameter_units(problem.active, estimate.scale)

        def cost(near: Estimate) -> float:
            return float(np.sum(whitening.residuals(residuals(problem, near)) ** 2))

        return System(whitening.residuals(r), whitening.slopes(J) * units, cost)

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
