"""T_base_ct of least squares: rigid, mirrored to show a mirrored list, of three markers as a triad, or affine."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.frames import frame_of_points
from puncture_twin.planning.geometry.rigid import apply, pose


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
