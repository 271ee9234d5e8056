"""How large the residuals of each pose are expected to be: the noise of both arms and of the image, propagated."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import skew
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals import across, needle_in_image, tip_points

LEAST_WEIGHT = 1e-12
"""A pose that is set aside keeps this weight: its residual's standard deviation is a million times as large."""


class Spread(NamedTuple):
    """The same spread for every pose; with equal parts inside and across the image this is unweighted least squares."""

    inside_mm: float
    """Of the tip's residual along each axis of the image."""
    across_mm: float
    """Of the tip's residual across the image, where the image itself measures nothing."""
    direction_rad: float
    """Of the direction's residual inside the image."""


UNWEIGHTED = Spread(1.0, 1.0, 1.0)
"""Every residual counts the same."""


def covariances(
    estimate: Estimate,
    recording: Recording,
    noise: Noise | Spread,
    v_image: Floats | None = None,
    lean_rad: float = 0.0,
) -> Floats:
    """Covariance of each pose's residuals, shape (n, 3, 3) of the tip, or (n, 5, 5) with the direction's two behind it.

    Args:
        estimate: Where the residuals are linearised.
        recording: The poses.
        noise: Propagated to first order through both arms and the image, or taken as it is.
        v_image: The measured directions, unit, shape (n, 3), where they are used.
        lean_rad: How far the needle leans out of the measured direction's plane across the image.
    """
    n, size = len(recording), 3 if v_image is None else 5
    sigma = np.zeros((n, size, size))
    if isinstance(noise, Spread):
        in_image = recording.A[:, :3, :3] @ estimate.R_X * [noise.inside_mm, noise.inside_mm, noise.across_mm]
        sigma[:, :3, :3] = in_image @ in_image.transpose(0, 2, 1)
    else:
        sigma += _propagated(estimate, recording, noise, v_image)
    if v_image is not None:
        sigma[:, 3, 3] += noise.direction_rad**2
        sigma[:, 4, 4] += lean_rad**2
    return sigma


def _propagated(estimate: Estimate, recording: Recording, noise: Noise, v_image: Floats | None) -> Floats:
    """Both flanges' and the tip's noise in the residuals; every source is independent and isotropic."""
    R_A, R_B = recording.A[:, :3, :3], recording.B[:, :3, :3]
    in_end1, _ = tip_points(estimate, recording)
    turn_A, turn_B = R_A @ skew(in_end1), -estimate.R_Y @ R_B @ skew(estimate.t_Q)
    if v_image is not None:
        M, rows = needle_in_image(estimate, recording), across(v_image)
        end1 = (M @ estimate.V) @ estimate.R_X.T
        turn_A = np.concatenate([turn_A, rows @ estimate.R_X.T @ skew(end1)], axis=1)
        turn_B = np.concatenate([turn_B, -rows @ M @ skew(estimate.V)], axis=1)
    sigma = noise.robot_rad**2 * (turn_A @ turn_A.transpose(0, 2, 1) + turn_B @ turn_B.transpose(0, 2, 1))
    in_image = (R_A @ estimate.R_X)[:, :, :2]
    sigma[:, :3, :3] += noise.image_mm**2 * in_image @ in_image.transpose(0, 2, 1)
    sigma[:, :3, :3] += 2 * noise.robot_mm**2 * np.eye(3)
    return np.asarray(sigma)


def whitener(sigma: Floats, weights: Floats) -> Floats:
    """W with W^T W the inverse covariance, each pose's times its weight; shape (n, k, k).

    Args:
        sigma: Shape (n, k, k).
        weights: Shape (n, k): one per residual; 0 sets it aside.
    """
    spread = 1.0 / np.sqrt(np.maximum(weights, LEAST_WEIGHT))
    scaled = sigma * spread[:, :, None] * spread[:, None, :]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(scaled)))
