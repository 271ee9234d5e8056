"""A camera from known points: direct linear transform, then the least reprojection error with the lens's distortion.

**What twelve points tell about the lens.** In an image that spans 28 degrees the grid of the robot's points fills a
radius of a tenth of the focal length. There k1 = -0.1 bends by a quarter of a pixel: a ball found to 0.02 px gives k1
to about 0.01. But k2 = 0.1 bends by 0.003 px and cannot be found; p1, p2 can, though mostly together with the principal
point. So each coefficient has a prior (normal, mean 0): what the points cannot show stays near 0 and keeps the prior's
variance, and ``identified`` names the coefficients whose standard deviation the points at least halved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.twin.guidance.stereo.cameras.bundle import (
    CAMERA_PARAMETERS,
    Bundle,
    Observations,
    PixelSpreads,
    adjust,
)
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera
from puncture_twin.twin.guidance.stereo.cameras.triangulation import LinearFit, decompose, fit_matrix, project

MIN_POINTS = 6
"""Eleven unknowns, two equations per point."""
COPLANAR = 0.02
"""Thickness over length of the point set (singular values) below which it counts as a plane."""
CRITICAL = 1e6
"""Condition of the linear system from which on the points do not determine the camera, though they fill space."""
LENS_PRIOR = (0.3, 0.3, 0.002, 0.002)
"""Standard deviations of k1, k2, p1, p2: lenses of industrial cameras rarely have more."""
IDENTIFIED = 0.5
"""Posterior over prior standard deviation up to which a coefficient counts as identified by the points."""
MAX_RESIDUAL_PX = 15.0
"""A point that misses by more was swapped with another or found wrongly: Hough alone misses by about one pixel."""
SMALLEST_SIGMA_PX = 1e-3
"""The pixels' error is never believed to be smaller."""
ROUNDS = 4
"""The pixels' error is estimated from the residuals and weighs the prior: a fixed point reached in two or three."""


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """A camera, and how well it is known.

    Attributes:
        camera: Refined.
        residuals_px: Shape (n, 2), found minus predicted.
        rms_px: Root mean square distance of the residuals.
        covariance: Shape (14, 14) in the order of ``bundle.CAMERA_PARAMETERS``; zero where fixed.
        sigma_px: Standard deviation per axis of a pixel: given, or estimated from the residuals.
        identified: The distortion coefficients that the points tell.
    """

    camera: Camera
    residuals_px: Floats
    rms_px: float
    covariance: Floats
    sigma_px: float
    identified: tuple[str, ...]


def calibrate(
    points_c: Floats,
    pixels: Floats,
    size: tuple[int, int],
    *,
    names: Sequence[str] | None = None,
    distortion: bool = True,
    sigma_px: float | None = None,
    where: str | Path = "camera calibration",
) -> CameraCalibration:
    """Calibrate one camera (Liu 2007, section 2, with a refinement that the paper does not have).

    Args:
        points_c: Shape (n, 3), mm, n >= 6, not in a plane.
        pixels: Shape (n, 2), where the points were found; NaN for a ball that was not found.
        size: Width and height of the image, px.
        names: What errors call the points; None numbers them from 1.
        distortion: False holds the lens perfect, as the paper does.
        sigma_px: Standard deviation of a pixel coordinate; None estimates it from the residuals.
        where: What errors name.

    Raises:
        InputError: Too few points, a ball not found, points in a plane or twice, a point behind the camera or that
            does not fit, a set that leaves the camera free.
    """
    points, found = np.asarray(points_c, dtype=np.float64), np.asarray(pixels, dtype=np.float64)
    _check_shapes(points, found, names, where)
    names = [f"point {i + 1}" for i in range(len(points))] if names is None else names
    _check_points(points, found, names, where)
    linear = fit_matrix(points, found)
    _check_linear(linear, points, found, names, where)
    start = _start(linear.M, size)
    bundle, sigma = _refine(start, points, found, distortion, sigma_px)
    _check_fit(bundle, points, names, where)
    covariance = bundle.camera_covariance(0)
    known = np.sqrt(np.diag(covariance)[4:8]) <= IDENTIFIED * np.array(LENS_PRIOR)
    identified = tuple(np.array(CAMERA_PARAMETERS[4:8])[known].tolist()) if distortion else ()
    return CameraCalibration(bundle.cameras[0], bundle.residuals_px, bundle.rms_px, covariance, sigma, identified)


def _start(M: Floats, size: tuple[int, int]) -> Camera:
    """The camera of a matrix: its skew is dropped."""
    K, T = decompose(M)
    return Camera(size[0], size[1], K[0, 0], K[1, 1], K[0, 2], K[1, 2], np.zeros(4), T)


def _refine(
    start: Camera, points: Floats, pixels: Floats, distortion: bool, sigma_px: float | None
) -> tuple[Bundle, float]:
    """The optimum, and the pixels' standard deviation that it was found with."""
    spread = np.full((1, 14), np.inf)
    spread[0, 4:8] = LENS_PRIOR if distortion else 0.0
    fixed = PixelSpreads(spread, np.zeros((1, 6)), np.zeros_like(points))
    count = np.arange(len(points))
    sigma = 0.05 if sigma_px is None else sigma_px
    for _ in range(ROUNDS):
        seen = Observations(np.zeros_like(count), np.zeros_like(count), count, pixels, sigma**2 * np.eye(2))
        bundle = adjust([start], np.eye(4)[None], points, seen, fixed)
        if sigma_px is not None:
            break
        known = _parameters_known(bundle, spread[0])
        spare = max(2 * len(points) - known, 1.0)
        sigma = max(float(np.sqrt(np.sum(bundle.residuals_px**2) / spare)), SMALLEST_SIGMA_PX)
    return bundle, sigma


def _parameters_known(bundle: Bundle, spread: Floats) -> float:
    """Parameters that the points determine: a free one counts 1, one with a prior by how much its variance fell."""
    variance = np.diag(bundle.camera_covariance(0))
    with np.errstate(divide="ignore", invalid="ignore"):
        known = 1 - variance / spread**2
    return float(np.sum(np.where(spread > 0, np.clip(known, 0, 1), 0)))


def _check_shapes(points: Floats, pixels: Floats, names: Sequence[str] | None, where: str | Path) -> None:
    count = len(points)
    if points.shape != (count, 3) or pixels.shape != (count, 2) or (names is not None and len(names) != count):
        what = f"points of shape {points.shape}, pixels of shape {pixels.shape}"
        refuse(what, where, "(n, 3), (n, 2), and n names if any", "wrong_shape")


def _check_points(points: Floats, pixels: Floats, names: Sequence[str], where: str | Path) -> None:
    lost = np.asarray(~np.isfinite(pixels).all(axis=1))
    if lost.any():
        refuse(f"ball not found: {_listed(names, lost)}", where, "a ball seen at every point", "ball_not_found")
    wrong = np.asarray(~np.isfinite(points).all(axis=1))
    if wrong.any():
        refuse(f"position not finite: {_listed(names, wrong)}", where, "finite mm", "not_finite")
    distinct = len(np.unique(points, axis=0))
    if distinct < MIN_POINTS:
        refuse(f"{distinct} distinct points", where, f"{MIN_POINTS} or more, not in a plane", "too_few_points")
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[2] < COPLANAR * spread[0]:
        what = f"the points are coplanar: thickness {spread[2] / spread[0]:.2g} of the length"
        allowed = f"a set whose thickness is at least {COPLANAR:g} of its length, such as a 3 x 2 x 2 grid"
        refuse(what, where, allowed, "points_coplanar")


def _check_linear(linear: LinearFit, points: Floats, pixels: Floats, names: Sequence[str], where: str | Path) -> None:
    if linear.condition > CRITICAL:
        allowed = "points not on a plane and a line, nor on a twisted cubic through the camera"
        refuse(f"the camera is undetermined (condition {linear.condition:.2g})", where, allowed, "undetermined")
    behind = np.asarray(points @ linear.M[2, :3] + linear.M[2, 3] <= 0)
    if behind.any():
        refuse(f"behind the camera: {_listed(names, behind)}", where, "points in front of the camera", "behind_camera")
    misses = np.linalg.norm(project(linear.M, points) - pixels, axis=1)
    _check_misses(misses, names, where)


def _check_fit(bundle: Bundle, points: Floats, names: Sequence[str], where: str | Path) -> None:
    unseen = np.asarray(~np.isfinite(bundle.cameras[0].project(points)).all(axis=1))
    if unseen.any():
        what = f"behind the camera or beyond its lens: {_listed(names, unseen)}"
        refuse(what, where, "all points in its view", "behind_camera")
    _check_misses(np.linalg.norm(bundle.residuals_px, axis=1), names, where)


def _check_misses(misses: Floats, names: Sequence[str], where: str | Path) -> None:
    worst = int(np.argmax(misses))
    if misses[worst] > MAX_RESIDUAL_PX:
        what = f"{names[worst]} misses by {misses[worst]:.1f} px: swapped, moved or wrongly detected"
        refuse(what, where, f"residuals up to {MAX_RESIDUAL_PX:g} px", "point_misses")


def _listed(names: Sequence[str], rows: NDArray[np.bool_]) -> str:
    return ", ".join(str(name) for name, row in zip(names, rows, strict=True) if row)
