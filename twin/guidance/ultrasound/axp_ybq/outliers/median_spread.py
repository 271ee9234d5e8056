"""The spread of the tips' residuals, from medians."""

from __future__ import annotations

import numpy as np

from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import HALF_NORMAL
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import Problem, Spread, linearise

LEAST_MM = 1e-9
"""Below this there is no noise, only rounding."""


def median_spread(problem: Problem, estimate: Estimate) -> Spread:
    """The tip's spread inside and across the image, from medians: outliers hardly move it."""
    to_image = (problem.recording.A[:, :3, :3] @ estimate.R_X).transpose(0, 2, 1)
    r = np.abs(to_image @ linearise(problem, estimate).residuals[:, :3, None])[:, :, 0]
    inside, across = (max(float(np.median(part)) / HALF_NORMAL, LEAST_MM) for part in (r[:, :2], r[:, 2]))
    return Spread(max(inside, across / 3), max(across, inside / 3), 1.0)
