"""What the arm does wrong at the target that it did not already do where it touched the markers."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.registration.fit_uncertainty import FitUncertainty


def not_cancelled(fit: FitUncertainty, J: Floats, target_base: Floats) -> Floats:
    """G = J_f - X L J: the arm's error Jacobian, the part that the registration takes off taken off.

    Where nobody says how the arm touched the markers, sqrt(2) J_f stands for it: errors of equal size at the markers
    and at the target, independent.

    Args:
        fit: What the registration makes of the declared errors: its map L and the arm's Jacobian J at the touches.
        J: Shape (n, 6, 28), J_f, of configurations with the tip on the target; tip (mm) then rotation (rad), base axes.
        target_base: Shape (3,), mm, to which X carries the registration's shift and rotation.

    Returns:
        Shape (n, 6, 28).
    """
    if not fit.noise.touches_known:
        return np.asarray(np.sqrt(2.0) * J)
    return np.asarray(J - fit.map_at(target_base) @ fit.noise.arm_jacobian)
