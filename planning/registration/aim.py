"""The insertion for which a pose is corrected, and how residuals tell of the arm's errors there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.arm.error_jacobian import error_jacobian
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.registration.reading_noise import ReadingNoise


@dataclass(frozen=True, eq=False)
class Aim:
    """The insertion for which a pose is corrected.

    Attributes:
        target_ct: Shape (3,), mm.
        q: Shape (6,), rad, the tip on the target.
        arm_jacobian: Shape (6, 28), J_f: how the arm's parameters move the needle there, base axes.
    """

    target_ct: Floats
    q: Floats
    arm_jacobian: Floats

    def response(self, noise: ReadingNoise, weights: Floats) -> Floats:
        """J_f Sigma_eta J' W, shape (..., 6, 3 N): motion of the pose at the target per residual, W (..., 3 N, 3 N)."""
        return np.asarray((self.arm_jacobian * noise.eta_variances) @ noise.arm_jacobian.T @ weights)


def aim_at(model: UrModel, tip_mm: float, target_ct: Floats, q: Floats) -> Aim:
    """The aim of an insertion in configuration q (6,), rad, at a target (3,), mm."""
    return Aim(target_ct, q, error_jacobian(model, q, tip_mm))
