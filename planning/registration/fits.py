"""T_base_ct from markers by each method: triad, least squares, weighted by noise, joint with the arm's errors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, frame_of_points, pose
from puncture_twin.planning.registration.fit_map import design_blocks
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.reading_noise import ReadingNoise

Method = Literal["triad", "rigid", "weighted", "joint", "affine"]

MAX_RESIDUAL_MM = 15.0
"""A marker that misses by more was swapped, moved or typed wrongly: the paper's worst set misses by 7 mm."""

MIRROR_GAIN = 2.0
"""A mirrored fit that is better than the proper one by this factor (and 1 mm) says that one side is mirrored."""

STEPS = 6
"""Gauss-Newton steps of the weighted fit: from the least-squares fit its error falls below 1e-12 mm in four."""


def fit_by(method: Method, noise: ReadingNoise | None) -> Callable[[Floats, Floats], Floats]:
    """The fit of a method: from points (..., n, 3) in both frames, mm, to T_base_ct."""
    if method == "weighted" and noise is not None:
        return lambda ct, base: fit_weighted(ct, base, noise, fit_rigid(ct, base))
    if method == "joint" and noise is not None:
        return lambda ct, base: fit_joint(ct, base, noise, fit_rigid(ct, base))
    return fit_triad if method == "triad" else fit_rigid


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


def fit_rigid(points_ct: Floats, points_base: Floats) -> Floats:
    """T_base_ct that minimises the squared residuals over rotations (Arun 1987, by SVD; det = +1 after Umeyama 1991).

    Args:
        points_ct: Shape (..., n, 3), n >= 3, not collinear, mm; one set, or many.
        points_base: Shape (..., n, 3), the same markers.
    """
    return _least_squares(points_ct, points_base, mirrored=False)


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
    weights = np.linalg.inv(noise.whole(R))
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


def fit_affine(points_ct: Floats, points_base: Floats) -> Floats:
    """The unconstrained 12-parameter least squares of the paper's Table 6, shape (4, 4). Not a rigid motion.

    With fewer than four markers that span space it is not unique, and the solution of least norm is taken.
    """
    homogeneous = np.column_stack([points_ct, np.ones(len(points_ct))])
    solution, *_ = np.linalg.lstsq(homogeneous, points_base, rcond=None)
    T = np.eye(4)
    T[:3] = solution.T
    return T


def rigid_fre(markers: MarkerPairs) -> float:
    """FRE of the least-squares fit, whatever the method: the chi-squared test is about that."""
    fitted = apply(fit_rigid(markers.points_ct, markers.points_base), markers.points_ct)
    return _rms(fitted - markers.points_base)


def _rms(residuals: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))


def check_residuals(markers: MarkerPairs, residuals: Floats, where: str | Path) -> None:
    """Refuse a fit that is far better mirrored, or that a marker misses by far.

    Args:
        markers: As fitted.
        residuals: Shape (n, 3), mm.
        where: What errors name.

    Raises:
        InputError: Naming the markers.
    """
    mirrored = _least_squares(markers.points_ct, markers.points_base, mirrored=True)
    best = _rms(apply(mirrored, markers.points_ct) - markers.points_base)
    if _rms(residuals) > MIRROR_GAIN * best + 1.0:
        raise InputError(
            f"markers {', '.join(markers.names)} match only mirrored (rms {best:.2f} mm against "
            f"{_rms(residuals):.2f} mm)",
            where=where,
            allowed="both sides right-handed: check LPS/RAS and the marker names",
        )
    lengths = np.linalg.norm(residuals, axis=1)
    worst = int(np.argmax(lengths))
    if lengths[worst] > MAX_RESIDUAL_MM:
        raise InputError(
            f"marker {markers.names[worst]} misses by {lengths[worst]:.1f} mm: swapped, moved or mistyped",
            where=where,
            allowed=f"residuals up to {MAX_RESIDUAL_MM:g} mm",
        )
