"""The covariance of markers read in a CT and touched by an arm: y_i = T x_i - J_i eta - Jq_i eps_i + n_i, stacked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats


class NoiseCovariance(NamedTuple):
    """The covariance of N stacked readings, mm^2, base axes."""

    independent: Floats
    """Omega, shape (..., 3 N, 3 N): what errs anew at each marker."""
    shared: Floats
    """J Sigma_eta J', shape (3 N, 3 N): what the arm does wrong at all markers together."""

    @property
    def whole(self) -> Floats:
        """C, shape (..., 3 N, 3 N): both."""
        return self.independent + self.shared

    @property
    def greatest_fle_mm(self) -> float:
        """The noise of the isotropic test that other pairings of the names are compared with: the worst axis in all.

        Residuals that pass the weighted test have |r|^2 <= lambda_max chi-squared: the given names pass this one too.
        """
        return float(np.sqrt(3 * np.linalg.eigvalsh(self.whole)[-1]))


@dataclass(frozen=True, eq=False)
class ReadingNoise:
    """What the readings of N markers may be off by, all normal with mean zero.

    Attributes:
        cov_ct: Shape (3, 3), mm^2, of each reading in the CT.
        cov_base: Shape (N, 3, 3), mm^2, of each touch: its own noise, and the arm's repeatability there.
        arm_jacobian: Shape (3 N, 28), how the arm's parameters move the tip at the touches.
        eta_variances: Shape (28,), of those parameters.
        touches_known: Whether the file says how the arm stood at the touches; else they are the planner's guess.
    """

    cov_ct: Floats
    cov_base: Floats
    arm_jacobian: Floats
    eta_variances: Floats
    touches_known: bool

    def covariance(self, R_base_ct: Floats) -> NoiseCovariance:
        """Of all readings stacked, CT axes rotated by (..., 3, 3)."""
        blocks = self.blocks(R_base_ct)
        count = blocks.shape[-3]
        omega = np.zeros((*blocks.shape[:-3], 3 * count, 3 * count))
        for row in range(count):
            omega[..., 3 * row : 3 * row + 3, 3 * row : 3 * row + 3] = blocks[..., row, :, :]
        shared = np.asarray((self.arm_jacobian * self.eta_variances) @ self.arm_jacobian.T)
        return NoiseCovariance(omega, shared)

    def blocks(self, R_base_ct: Floats) -> Floats:
        """Omega's blocks, shape (..., N, 3, 3), one a marker, for rotations (..., 3, 3)."""
        read = R_base_ct @ self.cov_ct @ np.swapaxes(R_base_ct, -1, -2)
        return np.asarray(read[..., None, :, :] + self.cov_base)
