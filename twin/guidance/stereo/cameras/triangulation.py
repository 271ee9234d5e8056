"""Points in C from pixels of several cameras: a linear start, then the least reprojection error.

The direct linear transform gives a camera's 3x4 matrix M from known points (`fit_matrix`), and points from matrices:

    z [u v 1]^T = M [x y z 1]^T                                                         (Liu 2007, Eq. 1)

Two equations per point, linear in the twelve entries, solved by SVD after moving and scaling both sides to zero mean
and a common scale (Hartley 1997; Hartley and Zisserman, Multiple View Geometry, algorithm 7.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import rq

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera

ROUNDS = 10
"""Gauss-Newton converges in two or three from the linear start."""
CONVERGED_MM = 1e-9
"""A step below this ends the search."""


class Points(NamedTuple):
    """Points in C, with what is known of their error."""

    points_c: Floats
    """Shape (n, 3), mm; NaN where a camera had no pixel."""
    covariance: Floats
    """Shape (n, 3, 3), mm^2, from the pixels' covariances alone: the cameras are taken as true."""


def triangulate(cameras: Sequence[Camera], pixels: Floats, covariances: Floats | None = None) -> Points:
    """Points that reproject best.

    Args:
        cameras: Two or more.
        pixels: Shape (n_cameras, n, 2), as found: distorted.
        covariances: Shape (n_cameras, n, 2, 2), px^2; None takes 1 px^2 for all, so that ``covariance`` must be
            multiplied by the pixels' variance.

    Raises:
        InputError: Fewer than two cameras, or shapes that do not fit.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    if len(cameras) < 2 or pixels.ndim != 3 or pixels.shape[::2] != (len(cameras), 2):
        allowed = "two or more cameras and pixels (cameras, n, 2)"
        refuse(f"{len(cameras)} cameras and pixels of shape {pixels.shape}", "triangulation", allowed, "wrong_shape")
    unit = np.broadcast_to(np.eye(2), (*pixels.shape, 2))
    whitening = np.linalg.inv(np.linalg.cholesky(unit if covariances is None else covariances))
    points = _linear(cameras, pixels)
    for _ in range(ROUNDS):
        miss, slope = _errors(cameras, points, pixels, whitening)
        information = slope.transpose(0, 2, 1) @ slope
        step = np.linalg.solve(information, np.einsum("nij,ni->nj", slope, miss)[..., None])[..., 0]
        points = points + step
        if not np.any(np.abs(step) > CONVERGED_MM):
            break
    slope = _errors(cameras, points, pixels, whitening)[1]
    return Points(points, np.asarray(np.linalg.inv(slope.transpose(0, 2, 1) @ slope)))


def _linear(cameras: Sequence[Camera], pixels: Floats) -> Floats:
    """The linear start, from pixels freed of distortion by their rays."""
    flat = []
    for camera, seen in zip(cameras, pixels, strict=True):
        rays = camera.rays(seen) @ camera.T_camera_c[:3, :3].T
        flat.append(rays[:, :2] / rays[:, 2:])
    points = np.full((pixels.shape[1], 3), np.nan)
    known = np.isfinite(flat).all(axis=(0, 2))
    if known.any():
        matrices = np.stack([camera.T_camera_c[:3] for camera in cameras])
        points[known] = reconstruct(matrices, np.stack(flat)[:, known])
    return points


def _errors(cameras: Sequence[Camera], points: Floats, pixels: Floats, whitening: Floats) -> tuple[Floats, Floats]:
    """Whitened reprojection errors (n, 2 cameras) and their slope by the point (n, 2 cameras, 3)."""
    miss = pixels - np.stack([camera.project(points) for camera in cameras])
    slope = np.stack([camera.jacobian(points) for camera in cameras])
    miss = np.einsum("cnij,cnj->nci", whitening, miss)
    slope = (whitening @ slope).transpose(1, 0, 2, 3)
    return miss.reshape(len(points), -1), slope.reshape(len(points), -1, 3)


class Decomposition(NamedTuple):
    """M = scale K [R t]."""

    K: Floats
    """Shape (3, 3), upper triangular, K[2, 2] = 1; K[0, 1] is the skew."""
    T_camera_c: Floats
    """Shape (4, 4), rigid."""


class LinearFit(NamedTuple):
    """A camera's matrix, and how well the points determine it."""

    M: Floats
    """Shape (3, 4), scaled such that M x gives depths in the points' unit, positive in front."""
    condition: float
    """Largest over second smallest singular value: infinite where the points leave M free."""


def fit_matrix(points: Floats, pixels: Floats) -> LinearFit:
    """Fit M by the normalised direct linear transform.

    Args:
        points: Shape (n, 3), n >= 6, any unit. Nothing is checked here; ``calibrate`` does.
        pixels: Shape (n, 2).
    """
    T_points, T_pixels = _normalising(points), _normalising(pixels)
    X = np.column_stack([points, np.ones(len(points))]) @ T_points.T
    x = np.column_stack([pixels, np.ones(len(pixels))]) @ T_pixels.T
    none = np.zeros_like(X)
    rows = np.concatenate([np.hstack([X, none, -x[:, :1] * X]), np.hstack([none, X, -x[:, 1:2] * X])])
    values, Vt = np.linalg.svd(rows, full_matrices=False)[1:]
    M = np.linalg.inv(T_pixels) @ Vt[-1].reshape(3, 4) @ T_points
    M = M / np.linalg.norm(M[2, :3])
    M = M * np.sign(np.median(points @ M[2, :3] + M[2, 3]))
    return LinearFit(M, float(values[0] / max(values[-2], 1e-300)))


def _normalising(points: Floats) -> Floats:
    """Homogeneous map to zero mean and a scale of about 1.

    The scale is the standard deviation of all coordinates taken as one list (Kwon's and Duarte's choice): noisy points
    have a slightly different linear optimum under each scale, and with this one the published numbers come out.
    """
    axes = points.shape[1]
    spread = max(float(np.std(points)), 1e-300)
    T = np.eye(axes + 1)
    T[:axes, :axes] /= spread
    T[:axes, axes] = -points.mean(axis=0) / spread
    return T


def decompose(M: Floats) -> Decomposition:
    """K, R and t of a matrix by RQ decomposition (Hartley and Zisserman, 6.2.4), shape (3, 4) in.

    The focal lengths come out positive and R proper.
    """
    M = M * np.sign(np.linalg.det(M[:, :3]))
    K, R = rq(M[:, :3])
    signs = np.diag(np.sign(np.diag(K)))
    K, R = K @ signs, signs @ R
    return Decomposition(K / K[2, 2], pose(R, np.linalg.solve(K, M[:, 3])))


def project(M: Floats, points: Floats) -> Floats:
    """Pixels (n, 2) of points (n, 3)."""
    homogeneous = points @ M[:, :3].T + M[:, 3]
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


def reconstruct(matrices: Floats, pixels: Floats) -> Floats:
    """Points seen in several views, linearly: the null vector of u m3 - m1 and v m3 - m2 of all views.

    Args:
        matrices: Shape (views, 3, 4). Each view's scale weighs it.
        pixels: Shape (views, n, 2), undistorted.

    Returns:
        Shape (n, 3).
    """
    rows = pixels.transpose(1, 0, 2)[..., None] * matrices[:, None, 2] - matrices[:, :2]
    rows = rows.reshape(pixels.shape[1], -1, 4)
    null = np.linalg.svd(rows)[2][:, -1]
    return np.asarray(null[:, :3] / null[:, 3:])
