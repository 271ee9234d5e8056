"""Least squares that single wrong poses cannot bend: find them, set them aside, fit the others.

1. Fit all. If no studentised residual stands out, that is the answer, at full efficiency.
2. Otherwise weigh residuals down as they grow, first by Huber's weights, then by Tukey's; the scale from the median.
3. Set aside what stands out there, fit the rest by plain (weighted) least squares, and look once more at all poses.
"""

from __future__ import annotations

import numpy as np
from scipy.special import gammaincinv

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.fitted import RobustFit
from puncture_twin.twin.guidance.ultrasound.axp_ybq.outliers.agreement import agreeing
from puncture_twin.twin.guidance.ultrasound.axp_ybq.outliers.settled import settled
from puncture_twin.twin.guidance.ultrasound.axp_ybq.outliers.studentised import blocks, scale, squared_size
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import (
    LinearModel,
    Problem,
    Spread,
    linear_model,
    median_spread,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.refine import refine

HUBER_STEPS, TUKEY_STEPS = 6, 12

HUBER, TUKEY = (float(np.sqrt(2 * gammaincinv(3 / 2, level))) for level in (0.8, 0.9999))
"""Where the weights begin to fall, and where they reach zero, in standard deviations."""

STILL_USED = 0.05
"""Tukey's weight from which on a pose counts as one that agrees."""


def plain_fit(problem: Problem, start: Estimate) -> RobustFit:
    """Least squares over all poses."""
    ones = np.ones(len(problem.recording))
    fit = refine(problem, start, ones, ones)
    return RobustFit(fit.estimate, ones > 0, ones > 0, fit.iterations)


def robust_fit(problem: Problem, start: Estimate) -> RobustFit:
    """Least squares over the poses that agree.

    Raises:
        InputError: More than half of the poses disagree.
    """
    fit = plain_fit(problem, start)
    if isinstance(problem.noise, Spread):
        problem = problem._replace(noise=median_spread(problem, fit.estimate))
    if all(part.all() for part in agreeing(problem, fit, alarm=True)):
        return fit
    return settled(problem, reweighted(problem, fit))


def reweighted(problem: Problem, fit: RobustFit) -> RobustFit:
    """Huber, then Tukey; every pose still counts as used, with a weight below 1."""
    estimate, weights = fit.estimate, [np.ones(len(problem.recording))] * 2
    for step in range(HUBER_STEPS + TUKEY_STEPS):
        model = linear_model(problem, estimate)
        r, sigma = model.residuals, _spread_of_one(model)
        for k, block in enumerate(blocks(problem)):
            size_squared = squared_size(r[:, block.rows], sigma[:, block.rows, block.rows])
            size = np.sqrt(size_squared / scale(size_squared, block))
            falls = np.minimum(1.0, HUBER / np.maximum(size, 1e-12))
            weights[k] = falls if step < HUBER_STEPS else np.maximum(1 - (size / TUKEY) ** 2, 0.0) ** 2
        estimate = refine(problem, estimate, *weights, max_steps=1).estimate
    steps = fit.iterations + HUBER_STEPS + TUKEY_STEPS
    return RobustFit(estimate, weights[0] > STILL_USED, weights[1] > STILL_USED, steps)


def _spread_of_one(model: LinearModel) -> Floats:
    """Covariance of each pose's residuals, whatever the arms' lasting errors are, shape (n, k, k)."""
    if model.shared is None:
        return model.sigma
    return np.asarray(model.sigma + model.shared @ model.shared.transpose(0, 2, 1))
