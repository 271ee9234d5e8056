"""The least-squares problem of a calibration: unknowns, data, the residuals' covariance by pose and in common.

The residuals themselves, and the letters, are in `direction`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.geometry.rigid import skew
from puncture_twin.twin.guidance.ultrasound.axp_ybq.arm_errors import FlangeErrors
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import DIRECTION, Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import (
    HALF_NORMAL,
    Linearised,
    across,
    direction_residuals,
    directions_image,
    linearised_direction,
    linearised_tip,
    needle_in_image,
    tip_points,
    tip_residuals,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording

Weights = Floats | Bools

LEAST_MM = 1e-9
"""Below this there is no noise, only rounding."""


class Spread(NamedTuple):
    """One spread for every pose; with equal parts inside and across the image this is unweighted least squares."""

    inside_mm: float
    """Deviation of the tip's residual along each axis of the image."""
    across_mm: float
    """Deviation of the tip's residual across the image, where the image itself measures nothing."""
    direction_rad: float
    """Deviation of the direction's residual inside the image."""


UNWEIGHTED = Spread(1.0, 1.0, 1.0)
"""Every residual counts the same."""


class Problem(NamedTuple):
    """A least-squares problem: a recording, its free unknowns, and its declared errors."""

    recording: Recording
    noise: Noise | Spread
    active: NDArray[np.int_]
    """Which of the 19 parameters are free."""
    lean_rad: float = 0.0
    """How far a needle may lean out of the slice and still be seen; across, the image shows no more of a direction."""
    arms: FlangeErrors | None = None
    """Errors of both arms, where they are declared."""

    @property
    def with_direction(self) -> bool:
        """Whether the measured directions take part."""
        return bool(self.active[-1] >= DIRECTION.start)


def residual_weights(problem: Problem, tip_weights: Weights, direction_weights: Weights) -> Floats:
    """One weight per residual, shape (n, k), from one per pose for tip and direction (a flag counts as 1 or 0)."""
    columns = [tip_weights] * 3 + [direction_weights] * (2 if problem.with_direction else 0)
    return np.column_stack(columns).astype(np.float64)


class LinearModel(NamedTuple):
    """A problem at an estimate: residuals, derivatives, and expected covariance."""

    residuals: Floats
    """Shape (n, k), k = 3, or 5 with directions."""
    jacobian: Floats
    """Shape (n, k, p), by the free parameters."""
    sigma: Floats
    """Expected covariance of each pose's own noise, shape (n, k, k)."""
    shared: Floats | None
    """Derivative by the arms' lasting errors, each in its standard deviation, shape (n, k, m); None undeclared."""


def linear_model(problem: Problem, estimate: Estimate) -> LinearModel:
    """The linearised problem at one estimate, for a fit or a test of it."""
    sigma, shared = _pose_covariances(problem, estimate), _shared_slopes(problem, estimate)
    r, J = linearise(problem, estimate)
    return LinearModel(r, J, sigma, shared)


def _pose_covariances(problem: Problem, estimate: Estimate) -> Floats:
    """The expected covariance of each pose's residuals, shape (n, k, k)."""
    v_image = directions_image(problem.recording, estimate) if problem.with_direction else None
    sigma = covariances(estimate, problem.recording, problem.noise, v_image, problem.lean_rad)
    if problem.arms is not None:
        slopes = flange_slopes(estimate, problem.recording, v_image)
        for by_flange, cov in zip(slopes, (one.arrival for one in problem.arms), strict=True):
            sigma = sigma + by_flange @ cov @ by_flange.transpose(0, 2, 1)
    return sigma


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
        sigma[:, 3, 3] += (noise.direction_rad * recording.direction_spread) ** 2
        sigma[:, 4, 4] += lean_rad**2
    return sigma


def _propagated(estimate: Estimate, recording: Recording, noise: Noise, v_image: Floats | None) -> Floats:
    """Covariance of the residuals from the noise of flanges and tip; every source is independent and isotropic."""
    R_A, R_B = recording.A[:, :3, :3], recording.B[:, :3, :3]
    in_end1, _ = tip_points(estimate, recording)
    turn_A, turn_B = R_A @ skew(in_end1), -estimate.R_Y @ R_B @ skew(estimate.t_Q)
    if v_image is not None:
        M, rows = needle_in_image(estimate, recording), across(v_image)
        end1 = (M @ estimate.V) @ estimate.R_X.T
        turn_A = np.concatenate([turn_A, rows @ estimate.R_X.T @ skew(end1)], axis=1)
        turn_B = np.concatenate([turn_B, -rows @ M @ skew(estimate.V)], axis=1)
    sigma = noise.robot_rad**2 * (turn_A @ turn_A.transpose(0, 2, 1) + turn_B @ turn_B.transpose(0, 2, 1))
    in_image = (R_A @ estimate.R_X)[:, :, : recording.P.shape[1]]
    sigma[:, :3, :3] += noise.image_mm**2 * in_image @ in_image.transpose(0, 2, 1)
    sigma[:, :3, :3] += 2 * noise.robot_mm**2 * np.eye(3)
    if noise.off_plane_mm and recording.P.shape[1] == 2:
        normal = (R_A @ estimate.R_X)[:, :, 2]
        sigma[:, :3, :3] += noise.off_plane_mm**2 * normal[:, :, None] * normal[:, None, :]
    return np.asarray(sigma)


def flange_slopes(estimate: Estimate, recording: Recording, v_image: Floats | None) -> tuple[Floats, Floats]:
    """The residuals' derivatives by a small motion of the probe's and of the needle's flange, each (n, k, 6).

    A motion is a shift and a turn about the flange's origin, along the axes of the arm's own base:
    dF = -(dt_A - [R_A p1]x dw_A) + R_Y (dt_B - [R_B t_Q]x dw_B), p1 = R_X S p + t_X, and of the direction
    dm = (R_A R_X)^T [R_Y R_B V]x dw_A - (R_A R_X)^T R_Y [R_B V]x dw_B.

    Args:
        estimate: Where to linearise.
        v_image: The measured directions, unit, shape (n, 3), where they are used.
    """
    n, size = len(recording), 3 if v_image is None else 5
    R_A, R_B = recording.A[:, :3, :3], recording.B[:, :3, :3]
    in_end1, _ = tip_points(estimate, recording)
    probe, needle = np.zeros((2, n, size, 6))
    probe[:, :3, :3], needle[:, :3, :3] = -np.eye(3), estimate.R_Y
    probe[:, :3, 3:] = skew((R_A @ in_end1[:, :, None])[:, :, 0])
    needle[:, :3, 3:] = -estimate.R_Y @ skew(R_B @ estimate.t_Q)
    if v_image is not None:
        rows = across(v_image) @ (R_A @ estimate.R_X).transpose(0, 2, 1)
        along = R_B @ estimate.V
        probe[:, 3:, 3:] = rows @ skew(along @ estimate.R_Y.T)
        needle[:, 3:, 3:] = -rows @ estimate.R_Y @ skew(along)
    return probe, needle


def _shared_slopes(problem: Problem, estimate: Estimate) -> Floats | None:
    """The residuals' derivative by the arms' lasting errors, each in its standard deviation, shape (n, k, m)."""
    if problem.arms is None:
        return None
    v_image = directions_image(problem.recording, estimate) if problem.with_direction else None
    by_probe, by_needle = flange_slopes(estimate, problem.recording, v_image)
    return np.concatenate([by_probe @ problem.arms.probe.slopes, by_needle @ problem.arms.needle.slopes], axis=2)


def linearise(problem: Problem, estimate: Estimate) -> Linearised:
    """All residuals (n, 3 or 5) and their Jacobian by the free parameters (n, 3 or 5, p)."""
    tip = linearised_tip(estimate, problem.recording)
    if not problem.with_direction:
        return Linearised(tip.residuals, tip.jacobian[:, :, problem.active])
    v_image = directions_image(problem.recording, estimate)
    turn = linearised_direction(estimate, problem.recording, v_image)
    jacobian = np.concatenate([tip.jacobian, turn.jacobian], axis=1)[:, :, problem.active]
    return Linearised(np.concatenate([tip.residuals, turn.residuals], axis=1), jacobian)


def residuals(problem: Problem, estimate: Estimate) -> Floats:
    """All residuals alone, shape (n, 3 or 5)."""
    tip = tip_residuals(estimate, problem.recording)
    if not problem.with_direction:
        return tip
    v_image = directions_image(problem.recording, estimate)
    return np.concatenate([tip, direction_residuals(estimate, problem.recording, v_image)], axis=1)


def median_spread(problem: Problem, estimate: Estimate) -> Spread:
    """The tip's spread inside and across the image, from medians: outliers hardly move it."""
    to_image = (problem.recording.A[:, :3, :3] @ estimate.R_X).transpose(0, 2, 1)
    r = np.abs(to_image @ linearise(problem, estimate).residuals[:, :3, None])[:, :, 0]
    inside, across = (max(float(np.median(part)) / HALF_NORMAL, LEAST_MM) for part in (r[:, :2], r[:, 2]))
    return Spread(max(inside, across / 3), max(across, inside / 3), 1.0)
