"""Least squares that single wrong poses cannot bend: find them, set them aside, fit the others.

1. Fit all. If no studentised residual stands out, that is the answer, at full efficiency.
2. Otherwise weigh residuals down as they grow, first by Huber's weights, then by Tukey's; the scale from the median.
3. Set aside what stands out there, fit the rest by plain (weighted) least squares, and look once more at all poses.
"""

from __future__ import annotations

import numpy as np

from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.fitted import RobustFit
from puncture_twin.twin.guidance.ultrasound.axp_ybq.outliers.agreement import agreeing
from puncture_twin.twin.guidance.ultrasound.axp_ybq.outliers.median_spread import median_spread
from puncture_twin.twin.guidance.ultrasound.axp_ybq.outliers.reweighting import reweighted
from puncture_twin.twin.guidance.ultrasound.axp_ybq.outliers.settled import settled
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import Problem, Spread
from puncture_twin.twin.guidance.ultrasound.axp_ybq.refine import refine


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
