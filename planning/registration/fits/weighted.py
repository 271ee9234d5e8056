"""T_base_ct weighted by the declared noise, and jointly with the arm's errors."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.geometry.rotations import exp_rotation
from puncture_twin.planning.registration.fits.fit_map import design_blocks
from puncture_twin.planning.registration.reading_noise import ReadingNoise

STEPS = 6
"""Gauss-Newton steps of the weighted fit: from the least-squares fit its error falls below 1e-12 mm in four."""


def fit_weighted(points_ct: Floats, points_base: Floats, noise: ReadingNoise, T_start: Floats) -> Floats:
    """T_base_ct, shape (..., 4, 4), that minimises z' Omega^-1 z over rigid motions, z the stacked residuals.

    Args:
        points_ct: Shape (..., N, 3), mm: one set of markers, or many of one noise.
        points_base: Shape (..., N, 3), mm.
        noise: Gives Omega, for the rotation found so far.
        T_start: Shape (..., 4, 4), such as the least-squares fit.
    """
    R, t, center = T_start[..., :3, :3], T_start[..., :3, 3], points_base.mean(axis=-2)
    for _ in range(STEPS):
        fitted = points_ct @ _transposed(R) + t[..., None, :]
        weights = np.linalg.inv(noise.blocks(R))
        A = design_blocks(fitted, center)
        weighted = np.swapaxes(A, -1, -2) @ weights
        normal, right = (weighted @ A).sum(axis=-3), weighted @ (points_base - fitted)[..., None]
        step = np.linalg.solve(normal, right.sum(axis=-3))[..., 0]
        turn = exp_rotation(step[..., 3:])
        t = (turn @ (t - center)[..., None])[..., 0] + center + step[..., :3]
        R = turn @ R
    U, _, Vt = np.linalg.svd(R)  # products of rotations drift from one by rounding
    return pose(U @ Vt, t)


def fit_joint(points_ct: Floats, points_base: Floats, noise: ReadingNoise, T_start: Floats) -> Floats:
    """T_base_ct, shape (..., 4, 4), that minimises z' C^-1 z: the arm's errors, common to all markers, count too.

    The arguments are those of `fit_weighted`. C is taken at T_start, from which the fit turns by little.
    """
    R, t, center = T_start[..., :3, :3], T_start[..., :3, 3], points_base.mean(axis=-2)
    weights = np.linalg.inv(noise.covariance(R).whole)
    for _ in range(STEPS):
        fitted = points_ct @ _transposed(R) + t[..., None, :]
        blocks = design_blocks(fitted, center)
        A = blocks.reshape(*blocks.shape[:-3], -1, 6)
        weighted = np.swapaxes(A, -1, -2) @ weights
        residuals = (points_base - fitted).reshape(*A.shape[:-1], 1)
        step = np.linalg.solve(weighted @ A, weighted @ residuals)[..., 0]
        turn = exp_rotation(step[..., 3:])
        t = (turn @ (t - center)[..., None])[..., 0] + center + step[..., :3]
        R = turn @ R
    U, _, Vt = np.linalg.svd(R)  # as in `fit_weighted`
    return pose(U @ Vt, t)


def _transposed(R: Floats) -> Floats:
    return np.swapaxes(R, -1, -2)
