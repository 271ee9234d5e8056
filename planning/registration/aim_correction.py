"""A pose corrected for what its own residuals tell of the arm: pose and arm errors estimated together.

Stacked readings are off by z = n - J eta, of covariance C = Omega + J Sigma_eta J'. With W = C^-1, L = (A' W A)^-1 A' W
and the residuals r = M z, M = I - A L, the arm's parameters are expected to be

    E[eta | r] = -Sigma_eta J' W r,

and the needle at an insertion, whose Jacobian is J_f, to be displaced by J_f E[eta | r]. The pose is moved by the
opposite. It is linear in z as every fit is, and M A = 0 leaves it unbiased:

    X L'' = X L + J_f Sigma_eta J' W M

stands in place of X L in every covariance. This is Gauss-Newton over pose and eta, with eta's declared prior. It is the
best for the one insertion whose J_f was taken, and honest for all others.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose
from puncture_twin.planning.registration.aim import Aim
from puncture_twin.planning.registration.fit_uncertainty import FitUncertainty
from puncture_twin.planning.registration.fits.least_squares import carried, design, fit_joint
from puncture_twin.planning.registration.reading_noise import ReadingNoise
from puncture_twin.planning.registration.registration import Registration


def aimed_fit(points_ct: Floats, points_base: Floats, noise: ReadingNoise, T_start: Floats, aim: Aim) -> Floats:
    """T_base_ct, shape (..., 4, 4), of pose and arm together, corrected for one insertion; as `fit_joint` otherwise."""
    return _aimed(fit_joint(points_ct, points_base, noise, T_start), points_ct, points_base, noise, aim)


def _aimed(T_base_ct: Floats, points_ct: Floats, points_base: Floats, noise: ReadingNoise, aim: Aim) -> Floats:
    """Joint fits (..., 4, 4) moved at the target by what their residuals tell of the arm."""
    R = T_base_ct[..., :3, :3]
    t = T_base_ct[..., None, :3, 3]
    residuals = points_base - points_ct @ np.swapaxes(R, -1, -2) - t
    weights = np.asarray(np.linalg.inv(noise.covariance(R).whole), dtype=np.float64)
    stacked = residuals.reshape(*residuals.shape[:-2], -1, 1)
    step = (aim.response(noise, weights) @ stacked)[..., 0]
    at = (R @ aim.target_ct) + t[..., 0, :]
    turn = exp_rotation(step[..., 3:])
    return pose(turn @ R, (turn @ (t[..., 0, :] - at)[..., None])[..., 0] + at + step[..., :3])


def aimed(registration: Registration, aim: Aim) -> Registration:
    """A joint registration, corrected for one insertion; its residuals stay those of the fit."""
    fit, markers = registration.uncertainty, registration.markers
    assert fit is not None  # a joint fit weighs by declared errors
    T = _aimed(registration.T_base_ct, markers.points_ct, markers.points_base, fit.noise, aim)
    T.setflags(write=False)
    target = apply(registration.T_base_ct, aim.target_ct)
    told = aimed_uncertainty(fit, markers.points_ct, T, target, aim)
    return replace(registration, T_base_ct=T, uncertainty=told, aim=aim)


def aimed_uncertainty(
    fit: FitUncertainty, points_ct: Floats, T_base_ct: Floats, target_base: Floats, aim: Aim
) -> FitUncertainty:
    """The uncertainty of a joint fit whose pose was corrected.

    Args:
        fit: Of the joint fit.
        points_ct: Shape (N, 3), mm, its markers.
        T_base_ct: Shape (4, 4), the corrected pose.
        target_base: Shape (3,), mm, where the pose was turned about.
        aim: What it was corrected for.
    """
    A = design(apply(T_base_ct, points_ct), fit.center_base)
    M = np.eye(len(A)) - A @ fit.fit_map
    weights = np.asarray(np.linalg.inv(fit.noise.covariance(fit.R_base_ct).whole), dtype=np.float64)
    at_center = carried(target_base, fit.center_base)  # the inverse of what carries from there to the target
    fit_map = fit.fit_map + at_center @ aim.response(fit.noise, weights) @ M
    return replace(fit, R_base_ct=T_base_ct[:3, :3], fit_map=np.asarray(fit_map))
