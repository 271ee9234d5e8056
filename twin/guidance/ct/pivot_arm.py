"""What an arm misses one place by in several poses, apart from its needle's tip, which is what a pivot finds."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.arm.error_jacobian import PARAMETERS
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.registration.reading_noise import reading_noise


def arm_covariance(errors: ErrorModel, model: UrModel, tip_mm: float, q: Floats) -> Floats:
    """Of n touches of one place, all that is declared but touch noise and the tip itself.

    Args:
        errors: As declared.
        model: The arm.
        tip_mm: Flange to tip.
        q: Shape (n, 6), rad.

    Returns:
        Shape (3 n, 3 n), mm^2.
    """
    noise = reading_noise(errors, model, tip_mm, q, known=True)
    variances = noise.eta_variances.copy()
    variances[PARAMETERS["tip_offset"]] = variances[PARAMETERS["needle_direction"]] = 0.0
    anew = noise.cov_base - errors.touch_mm**2 * np.eye(3)
    found = (noise.arm_jacobian * variances) @ noise.arm_jacobian.T
    for row, block in enumerate(anew):
        found[3 * row : 3 * row + 3, 3 * row : 3 * row + 3] += block
    return np.asarray(found)
