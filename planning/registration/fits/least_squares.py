"""T_base_ct of least squares: rigid, or mirrored to show a mirrored list."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import pose


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
