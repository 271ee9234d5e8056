"""T_base_ct by each method: rigid, mirrored, triad, affine, weighted, joint; and the map from reading errors to it.

With A_i = [I, -[p_i - c]x] stacked and weights W, a reading error z moves the fitted pose by L z, L = (A' W A)^-1 A' W:
a shift of the centroid c, then a rotation about it, base axes. The weighted fit is Gauss-Newton along this map:
Moghari, Abolmaesumi, IEEE TMI 26(12), 2007; Danilchenko, Fitzpatrick, IEEE TMI 30(3), 2011.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, frame_of_points, log_rotation, pose, skew
from puncture_twin.planning.registration.reading_noise import ReadingNoise

NUDGE_MM = 1e-4
"""Of central differences of a method that has no formula of its own; their error is 1e-9 of the map."""


def design(points_base: Floats, center_base: Floats) -> Floats:
    """A, shape (3 N, 6), of points (N, 3) about a centre (3,): how a shift and a rotation (rad) move them."""
    return design_blocks(points_base, center_base).reshape(-1, 6)


def least_squares_map(A: Floats, weights: Floats | None = None) -> Floats:
    """L, shape (6, 3 N), of a design (3 N, 6) and weights (3 N, 3 N); None weighs all alike."""
    weighted = A.T if weights is None else A.T @ weights
    return np.asarray(np.linalg.solve(weighted @ A, weighted))


def design_blocks(points: Floats, center: Floats) -> Floats:
    """A_i = [I, -[p_i - c]x], shape (..., N, 3, 6)."""
    eye = np.broadcast_to(np.eye(3), (*points.shape, 3))
    return np.concatenate([eye, -skew(points - center[..., None, :])], axis=-1)


def differenced_map(fit: Callable[[Floats, Floats], Floats], points_ct: Floats, points_base: Floats) -> Floats:
    """L, shape (6, 3 N), of any method, by central differences of its pose over the base readings."""
    center = points_base.mean(axis=0)
    T = fit(points_ct, points_base)
    columns = []
    for k in range(points_base.size):
        nudge = np.zeros(points_base.size)
        nudge[k] = NUDGE_MM
        moved = [fit(points_ct, points_base + sign * nudge.reshape(-1, 3)) for sign in (1.0, -1.0)]
        back = np.linalg.inv(T)
        shift = (apply(moved[0], apply(back, center)) - apply(moved[1], apply(back, center))) / (2 * NUDGE_MM)
        turn = log_rotation(moved[0][:3, :3] @ moved[1][:3, :3].T) / (2 * NUDGE_MM)
        columns.append(np.concatenate([shift, turn]))
    return np.array(columns).T


def carried(center_base: Floats, point_base: Floats) -> Floats:
    """X, shape (6, 6): a shift and rotation about a centre (3,) as they arrive at another point (3,)."""
    X = np.eye(6)
    X[:3, 3:] = -skew(point_base - center_base)
    return X


def fit_rigid(points_ct: Floats, points_base: Floats) -> Floats:
    """T_base_ct that minimises the squared residuals over rotations (Arun 1987, by SVD; det = +1 after Umeyama 1991).

    Args:
        points_ct: Shape (..., n, 3), n >= 3, not collinear, mm; one set, or many.
        points_base: Shape (..., n, 3), the same markers.
    """
    return _least_squares(points_ct, points_base, mirrored=False)


def rigid_fre_mm(points_ct: Floats, points_base: Floats) -> float:
    """The fiducial registration error (rms residual) of `fit_rigid`, mm: the chi-squared test is about that.

    Args:
        points_ct: Shape (n, 3), n >= 3, not collinear, mm.
        points_base: Shape (n, 3), the same markers.
    """
    residuals = apply(fit_rigid(points_ct, points_base), points_ct) - points_base
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))


def _least_squares(points_ct: Floats, points_base: Floats, *, mirrored: bool) -> Floats:
    center_ct, center_base = points_ct.mean(axis=-2), points_base.mean(axis=-2)
    spread = np.swapaxes(points_base - center_base[..., None, :], -1, -2) @ (points_ct - center_ct[..., None, :])
    U, _, Vt = np.linalg.svd(spread)
    sign = np.sign(np.linalg.det(U @ Vt)) * (-1.0 if mirrored else 1.0)
    U = U * np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)[..., None, :]
    R = U @ Vt
    return _rigid(R, center_base - (R @ center_ct[..., None])[..., 0])


def _rigid(R: Floats, t: Floats) -> Floats:
    T = pose(R, t)
    T.setflags(write=False)
    return T


def fit_triad(points_ct: Floats, points_base: Floats) -> Floats:
    """T_base_ct by the frames that three markers span (Chen 2019, Eq. 1-9).

    R_base_ct = R_base R_ct^T; the translation is the mean over the three markers.

    Args:
        points_ct: Shape (..., 3, 3), rows M1, M2, M3, mm; one set, or many.
        points_base: Shape (..., 3, 3), the same markers.
    """
    R_ct = np.swapaxes(frame_of_points(points_ct), -1, -2)
    R = frame_of_points(points_base) @ R_ct
    return _rigid(R, np.mean(points_base - points_ct @ np.swapaxes(R, -1, -2), axis=-2))


def fit_affine(points_ct: Floats, points_base: Floats) -> Floats:
    """The unconstrained 12-parameter least squares of the paper's Table 6, shape (4, 4). Not a rigid motion.

    With fewer than four markers that span space it is not unique, and the solution of least norm is taken.
    """
    homogeneous = np.column_stack([points_ct, np.ones(len(points_ct))])
    solution, *_ = np.linalg.lstsq(homogeneous, points_base, rcond=None)
    T = np.eye(4)
    T[:3] = solution.T
    return T


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
