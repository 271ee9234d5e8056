"""Where in C the cameras' pixels meet: a linear start, then the least reprojection error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera
from puncture_twin.twin.guidance.stereo.cameras.dlt import reconstruct

ROUNDS = 10
"""Gauss-Newton converges in two or three from the linear start."""
CONVERGED_MM = 1e-9
"""A step below this ends the search."""


class Points(NamedTuple):
    """Points in C, with what is known of their error."""

    points_c: Floats
    """Shape (n, 3), mm; NaN where a camera had no pixel."""
    residual_px: Floats
    """Root mean square reprojection error over the cameras, shape (n,): distance, px."""
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
        raise InputError(
            f"{len(cameras)} cameras and pixels of shape {pixels.shape}",
            where="triangulation",
            allowed="two or more cameras and pixels (cameras, n, 2)",
        )
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
    residuals = np.stack([camera.project(points) for camera in cameras]) - pixels
    residual = np.sqrt(np.mean(np.sum(residuals**2, axis=-1), axis=0))
    slope = _errors(cameras, points, pixels, whitening)[1]
    return Points(points, np.asarray(residual), np.asarray(np.linalg.inv(slope.transpose(0, 2, 1) @ slope)))


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
