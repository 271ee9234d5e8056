"""Which tips and which directions agree with a fit."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Bools
from puncture_twin.twin.guidance.ultrasound.axp_ybq.fitted import RobustFit, weighed
from puncture_twin.twin.guidance.ultrasound.axp_ybq.outliers.studentised import blocks, lifted, scale, squared_size
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import Problem
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals.direction_residuals import facing

ALARM_FRACTION = 0.6
"""Fraction of the spread that is believed while outliers may be in it: a false alarm costs time, not accuracy."""


def agreeing(problem: Problem, fit: RobustFit, *, alarm: bool = False) -> tuple[Bools, Bools]:
    """Which tips and which directions agree with the fit, given how far each one pulled it.

    Args:
        problem: What was fitted.
        fit: The fit.
        alarm: Only ask whether a closer look is due, after a fit of all poses, whose outliers widen the spread.
    """
    at_fit = weighed(problem, fit)
    r, J, sigma, C = at_fit.residuals, at_fit.jacobian, at_fit.sigma, at_fit.covariance
    pulled = J @ C @ J.transpose(0, 2, 1)
    kept = []
    for block, used in zip(blocks(problem), (fit.tip_kept, fit.direction_kept), strict=False):
        own = sigma[:, block.rows, block.rows]
        sign = np.where(used, -1.0, 1.0)[:, None, None]
        S = own + sign * pulled[:, block.rows, block.rows]
        size = squared_size(r[:, block.rows], lifted(S, own))
        believed = scale(size[used], block, ALARM_FRACTION if alarm else 1.0)
        kept.append(size <= block.limit * believed)
    return kept[0], kept[1] & facing(fit.estimate, problem.recording) if problem.with_direction else fit.direction_kept
