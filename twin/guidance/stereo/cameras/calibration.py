"""A camera from known points: direct linear transform, then the least reprojection error with the lens's distortion.

**What twelve points tell about the lens.** In an image that spans 28 degrees the grid of the robot's points fills a
radius of a tenth of the focal length. There k1 = -0.1 bends by a quarter of a pixel: a ball found to 0.02 px gives k1
to about 0.01. But k2 = 0.1 bends by 0.003 px and cannot be found; p1, p2 can, though mostly together with the principal
point. So each coefficient has a prior (normal, mean 0): what the points cannot show stays near 0 and keeps the prior's
variance.

The lens and the pose are refined together by Levenberg-Marquardt (MINPACK, Moré 1978) with the analytic Jacobian of
`camera_slope`; rotations and translations move as  p -> Exp(w) p + t  in the camera's frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from puncture_twin.planning.base.arrays import Floats, rms
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, left_jacobian, pose, skew
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera, coefficient_slope, distort
from puncture_twin.twin.guidance.stereo.cameras.triangulation import LinearFit, decompose, fit_matrix, project

MIN_POINTS = 6
"""Eleven unknowns, two equations per point."""
COPLANAR = 0.02
"""Thickness over length of the point set (singular values) below which it counts as a plane."""
CRITICAL = 1e6
"""Condition of the linear system from which on the points do not determine the camera, though they fill space."""
LENS_PRIOR = (0.3, 0.3, 0.002, 0.002)
"""Standard deviations of k1, k2, p1, p2: lenses of industrial cameras rarely have more."""
TOLERANCE = 1e-12
"""Relative change of cost or parameters that ends the search."""
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
        covariance: Shape (14, 14) in the order of `camera_slope`; zero where fixed.
    """

    camera: Camera
    residuals_px: Floats
    covariance: Floats

    @property
    def rms_px(self) -> float:
        """Root mean square distance of the residuals."""
        return rms(self.residuals_px)


def calibrate(
    points_c: Floats,
    pixels: Floats,
    size: tuple[int, int],
    *,
    names: Sequence[str] | None = None,
    distortion: bool = True,
    where: str | Path = "camera calibration",
) -> CameraCalibration:
    """Calibrate one camera (Liu 2007, section 2, with a refinement that the paper does not have).

    Args:
        points_c: Shape (n, 3), mm, n >= 6, not in a plane.
        pixels: Shape (n, 2), where the points were found; NaN for a ball that was not found.
        size: Width and height of the image, px.
        names: What errors call the points; None numbers them from 1.
        distortion: False holds the lens perfect, as the paper does.

    Raises:
        InputError: Too few points, a ball not found, points in a plane or twice, a point behind the camera or that
            does not fit, a set that leaves the camera free.
    """
    points, pixels = np.asarray(points_c, dtype=np.float64), np.asarray(pixels, dtype=np.float64)
    _check_shapes(points, pixels, names, where)
    names = [f"point {i + 1}" for i in range(len(points))] if names is None else names
    _check_points(points, pixels, names, where)
    linear = fit_matrix(points, pixels)
    _check_linear(linear, points, pixels, names, where)
    start = _start(linear.M, size)
    found = _refine(start, points, pixels, distortion)
    _check_fit(found, points, names, where)
    return found


def _start(M: Floats, size: tuple[int, int]) -> Camera:
    """The camera of a matrix: its skew is dropped."""
    K, T = decompose(M)
    return Camera(size[0], size[1], K[0, 0], K[1, 1], K[0, 2], K[1, 2], np.zeros(4), T)


def _refine(start: Camera, points: Floats, pixels: Floats, distortion: bool) -> CameraCalibration:
    """The optimum; the pixels' standard deviation, by which the prior is weighed, is estimated from the residuals."""
    spread, sigma = np.full(14, np.inf), 0.05
    spread[4:8] = LENS_PRIOR if distortion else 0.0
    for _ in range(ROUNDS):
        found = _fitted(start, points, pixels, spread, sigma**2)
        spare = max(2 * len(points) - _parameters_known(found.covariance, spread), 1.0)
        sigma = max(float(np.sqrt(np.sum(found.residuals_px**2) / spare)), SMALLEST_SIGMA_PX)
    return found


def _fitted(start: Camera, points: Floats, pixels: Floats, spread: Floats, variance: float) -> CameraCalibration:
    """The camera of least reprojection error, its parameters with normal priors about the start.

    Args:
        spread: Shape (14,), standard deviations of the priors: 0 fixes, infinity frees.
        variance: Of a pixel coordinate, px^2.
    """
    free = spread > 0
    prior, weight = np.isfinite(spread[free]), 1.0 / np.sqrt(variance)  # an infinite one has no prior row

    def change(x: Floats) -> Floats:
        every = np.zeros(14)
        every[free] = x
        return every

    def errors(x: Floats) -> Floats:
        miss = _project(_moved(start, change(x)), points) - pixels
        return np.concatenate([(weight * miss).ravel(), (x / spread[free])[prior]])  # pixels, then priors

    def jacobian(x: Floats) -> Floats:
        every = change(x)
        slope = camera_slope(_moved(start, every), points, (every[8:11], every[11:]))
        return np.concatenate([(weight * slope).reshape(-1, 14)[:, free], np.diag(1 / spread[free])[prior]])

    nothing = np.zeros(int(free.sum()))
    slopes = np.linalg.norm(jacobian(nothing), axis=0)
    scale = 1 / np.where(slopes > 0, slopes, 1.0)
    fit = least_squares(errors, nothing, jacobian, method="lm", x_scale=scale, ftol=TOLERANCE, xtol=TOLERANCE)
    camera, J, covariance = _moved(start, change(fit.x)), jacobian(fit.x), np.zeros((14, 14))
    covariance[np.ix_(free, free)] = _inverse(J.T @ J)
    return CameraCalibration(camera, pixels - _project(camera, points), covariance)


def _inverse(information: Floats) -> Floats:
    """Inverse after scaling to a unit diagonal: the parameters' units differ by powers of ten."""
    scale = 1 / np.sqrt(np.diag(information))
    if not np.isfinite(scale).all() or np.linalg.cond(information * np.outer(scale, scale)) > 1e15:
        refuse(
            "nothing determines a parameter",
            "camera calibration",
            "more points that are not in a plane",
            "undetermined",
        )
    return np.asarray(np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))


def _project(camera: Camera, points_c: Floats) -> Floats:
    """Project like ``Camera.project``, but smoothly everywhere: a step of the search may pass behind the camera."""
    points = apply(camera.T_camera_c, points_c)
    flat = points[:, :2] / points[:, 2:]
    return np.asarray(distort(flat, camera.distortion) * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def camera_slope(camera: Camera, points_c: Floats, turn: tuple[Floats, Floats]) -> Floats:
    """Derivative of the pixels by fx, fy, cx, cy (px), k1, k2, p1, p2, w (rad) and t (mm), shape (n, 2, 14).

    Args:
        turn: w and t, shape (3,) each, by which the camera's frame has moved from where they are 0.
    """
    points = apply(camera.T_camera_c, points_c)
    flat = points[:, :2] / points[:, 2:]
    bent = distort(flat, camera.distortion)
    focal = np.array([camera.fx, camera.fy])
    by_point = camera.jacobian(points_c) @ camera.T_camera_c[:3, :3].T
    slope = np.zeros((len(points), 2, 14))
    slope[:, 0, 0], slope[:, 1, 1] = bent[:, 0], bent[:, 1]
    slope[:, 0, 2] = slope[:, 1, 3] = 1.0
    slope[:, :, 4:8] = focal[:, None] * coefficient_slope(flat)
    slope[:, :, 8:11] = by_point @ (-skew(points - turn[1]) @ left_jacobian(turn[0]))  # d Exp(w) p / dw
    slope[:, :, 11:14] = by_point
    return slope


def _moved(camera: Camera, change: Floats) -> Camera:
    fx, fy, cx, cy = (np.array([camera.fx, camera.fy, camera.cx, camera.cy]) + change[:4]).tolist()
    T = pose(exp_rotation(change[8:11]), change[11:14]) @ camera.T_camera_c
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=camera.distortion + change[4:8], T_camera_c=T)


def _parameters_known(covariance: Floats, spread: Floats) -> float:
    """Parameters that the points determine: a free one counts 1, one with a prior by how much its variance fell."""
    with np.errstate(divide="ignore", invalid="ignore"):
        known = 1 - np.diag(covariance) / spread**2
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


def _check_fit(found: CameraCalibration, points: Floats, names: Sequence[str], where: str | Path) -> None:
    unseen = np.asarray(~np.isfinite(found.camera.project(points)).all(axis=1))
    if unseen.any():
        what = f"behind the camera or beyond its lens: {_listed(names, unseen)}"
        refuse(what, where, "all points in its view", "behind_camera")
    _check_misses(np.linalg.norm(found.residuals_px, axis=1), names, where)


def _check_misses(misses: Floats, names: Sequence[str], where: str | Path) -> None:
    worst = int(np.argmax(misses))
    if misses[worst] > MAX_RESIDUAL_PX:
        what = f"{names[worst]} misses by {misses[worst]:.1f} px: swapped, moved or wrongly detected"
        refuse(what, where, f"residuals up to {MAX_RESIDUAL_PX:g} px", "point_misses")


def _listed(names: Sequence[str], rows: NDArray[np.bool_]) -> str:
    return ", ".join(str(name) for name, row in zip(names, rows, strict=True) if row)
