"""A camera from known points, and points from the pixels of several cameras.

The direct linear transform gives a camera's 3x4 matrix M from known points (`fit_matrix`), and points from matrices:

    z [u v 1]^T = M [x y z 1]^T                                                         (Liu 2007, Eq. 1)

Two equations per point, linear in the twelve entries, solved by SVD after moving and scaling both sides to zero mean
and a common scale (Hartley 1997; Hartley and Zisserman, Multiple View Geometry, algorithm 7.1). From that start follow
the least reprojection errors: of points, and of the camera with its lens's distortion.

**What twelve points tell about the lens.** In an image that spans 28 degrees the grid of the robot's points fills a
radius of a tenth of the focal length. There k1 = -0.1 bends by a quarter of a pixel: a ball found to 0.02 px gives k1
to about 0.01. But k2 = 0.1 bends by 0.003 px and cannot be found; p1, p2 can, though mostly together with the principal
point. So each coefficient has a prior (normal, mean 0): what the points cannot show stays near 0 and keeps the prior's
variance.

The lens and the pose are refined together by Levenberg-Marquardt (MINPACK, Moré 1978) with the analytic Jacobian of
`camera_slope`; rotations and translations move as  p -> Exp(w) p + t  in the camera's frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq
from scipy.optimize import least_squares

from puncture_twin.planning.base.arrays import Floats, rms
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, left_jacobian, pose, skew
from puncture_twin.twin.guidance.stereo.camera import Camera, coefficient_slope, distort

TRIANGULATION_ROUNDS = 10
"""Gauss-Newton converges in two or three from the linear start."""
CONVERGED_MM = 1e-9
"""A step below this ends the search."""


class Points(NamedTuple):
    """Points (n, 3) in C, mm, NaN where a camera had no pixel; covariance (n, 3, 3), mm^2, from the pixels' alone."""

    points_c: Floats  # shape (n, 3), mm; NaN where a camera had no pixel
    covariance: Floats


def triangulate(cameras: Sequence[Camera], pixels: Floats, covariances: Floats) -> Points:
    """Points that reproject best from pixels (cameras, n, 2) as found, distorted, covariances (cameras, n, 2, 2)."""
    whitening = np.linalg.inv(np.linalg.cholesky(covariances))
    points = _linear(cameras, pixels)
    for _ in range(TRIANGULATION_ROUNDS):
        miss, slope = _errors(cameras, points, pixels, whitening)
        information = slope.transpose(0, 2, 1) @ slope
        step = np.linalg.solve(information, np.einsum("nij,ni->nj", slope, miss)[..., None])[..., 0]
        points = points + step
        if not np.any(np.abs(step) > CONVERGED_MM):
            break
    slope = _errors(cameras, points, pixels, whitening)[1]
    return Points(points, np.asarray(np.linalg.inv(slope.transpose(0, 2, 1) @ slope)))


def _linear(cameras: Sequence[Camera], pixels: Floats) -> Floats:
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
    """M = scale K [R t]: K (3, 3), upper triangular, K[2, 2] = 1, K[0, 1] the skew; T_camera_c (4, 4), rigid."""

    K: Floats
    T_camera_c: Floats


class LinearFit(NamedTuple):
    """A camera's matrix (3, 4), scaled such that M x gives depths in the points' unit, positive in front."""

    M: Floats
    condition: float  # largest over second smallest singular value: infinite where the points leave M free


def fit_matrix(points: Floats, pixels: Floats) -> LinearFit:
    """Fit M by the normalised direct linear transform to points (n, 3), n >= 6, any unit, and pixels (n, 2)."""
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
    """K, its focal lengths positive, R, proper, and t of a matrix (3, 4) by RQ (Hartley and Zisserman, 6.2.4)."""
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
    """Points (n, 3) seen in several views, linearly: the null vector of u m3 - m1 and v m3 - m2 of all views.

    Of matrices (views, 3, 4), whose scale weighs each view, and undistorted pixels (views, n, 2).
    """
    rows = pixels.transpose(1, 0, 2)[..., None] * matrices[:, None, 2] - matrices[:, :2]
    rows = rows.reshape(pixels.shape[1], -1, 4)
    null = np.linalg.svd(rows)[2][:, -1]
    return np.asarray(null[:, :3] / null[:, 3:])


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
    """A refined camera, its residuals (n, 2), found minus predicted, and its covariance (14, 14), zero where fixed."""

    camera: Camera
    residuals_px: Floats  # shape (n, 2), found minus predicted
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

    Points (n, 3), mm, n >= 6, are not in a plane; the pixels (n, 2), finite, are where they were found, in an image of
    a size (width, height). Errors call them by their names, or number them from 1. Without distortion the lens is
    perfect, as the paper has it.

    Raises:
        InputError: Too few points, points in a plane or twice, a point behind the camera or that does not fit, a set
            that leaves the camera free.
    """
    points, pixels = np.asarray(points_c, dtype=np.float64), np.asarray(pixels, dtype=np.float64)
    names = [f"point {i + 1}" for i in range(len(points))] if names is None else names
    _check_points(points, where)
    linear = fit_matrix(points, pixels)
    if linear.condition > CRITICAL:
        allowed = "points not on a plane and a line, nor on a twisted cubic through the camera"
        refuse(f"the camera is undetermined (condition {linear.condition:.2g})", where, allowed, "undetermined")
    behind = np.asarray(points @ linear.M[2, :3] + linear.M[2, 3] <= 0)
    if behind.any():
        refuse(f"behind the camera: {_listed(names, behind)}", where, "points in front of the camera", "behind_camera")
    _check_misses(project(linear.M, points) - pixels, names, where)
    K, T = decompose(linear.M)  # its skew is dropped
    start = Camera(size[0], size[1], K[0, 0], K[1, 1], K[0, 2], K[1, 2], np.zeros(4), T)
    spread, sigma = np.full(14, np.inf), 0.05  # the pixels' deviation weighs the prior, and the residuals estimate it
    spread[4:8] = LENS_PRIOR if distortion else 0.0
    for _ in range(ROUNDS):
        fitted = _fitted(start, points, pixels, spread, sigma**2)
        with np.errstate(divide="ignore", invalid="ignore"):  # a prior's parameter is known as its variance fell
            known = np.where(spread > 0, np.clip(1 - np.diag(fitted.covariance) / spread**2, 0, 1), 0)
        spare = max(2 * len(points) - float(np.sum(known)), 1.0)
        sigma = max(float(np.sqrt(np.sum(fitted.residuals_px**2) / spare)), SMALLEST_SIGMA_PX)
    unseen = np.asarray(~np.isfinite(fitted.camera.project(points)).all(axis=1))
    if unseen.any():
        what = f"behind the camera or beyond its lens: {_listed(names, unseen)}"
        refuse(what, where, "all points in its view", "behind_camera")
    _check_misses(fitted.residuals_px, names, where)
    return fitted


def _fitted(start: Camera, points: Floats, pixels: Floats, spread: Floats, variance: float) -> CameraCalibration:
    """The camera of least reprojection error, with normal priors about the start: spread 0 fixes, infinity frees."""
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
    scale = 1 / np.sqrt(np.diag(J.T @ J))  # to a unit diagonal: the parameters' units differ by powers of ten
    scales = np.outer(scale, scale)
    if not np.isfinite(scale).all() or np.linalg.cond(J.T @ J * scales) > 1e15:
        allowed = "more points that are not in a plane"
        refuse("nothing determines a parameter", "camera calibration", allowed, "undetermined")
    covariance[np.ix_(free, free)] = np.linalg.inv(J.T @ J * scales) * scales
    return CameraCalibration(camera, pixels - _project(camera, points), covariance)


def _project(camera: Camera, points_c: Floats) -> Floats:
    """Project like ``Camera.project``, but smoothly everywhere: a step of the search may pass behind the camera."""
    points = apply(camera.T_camera_c, points_c)
    flat = points[:, :2] / points[:, 2:]
    return np.asarray(distort(flat, camera.distortion) * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def camera_slope(camera: Camera, points_c: Floats, turn: tuple[Floats, Floats]) -> Floats:
    """Derivative of the pixels by fx, fy, cx, cy (px), k1, k2, p1, p2, w (rad) and t (mm), shape (n, 2, 14).

    The camera's frame has moved by the turn w (3,) and shift t (3,) from where they are 0.
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


def _check_points(points: Floats, where: str | Path) -> None:
    distinct = len(np.unique(points, axis=0))
    if distinct < MIN_POINTS:
        refuse(f"{distinct} distinct points", where, f"{MIN_POINTS} or more, not in a plane", "too_few_points")
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[2] < COPLANAR * spread[0]:
        what = f"the points are coplanar: thickness {spread[2] / spread[0]:.2g} of the length"
        allowed = f"a set whose thickness is at least {COPLANAR:g} of its length, such as a 3 x 2 x 2 grid"
        refuse(what, where, allowed, "points_coplanar")


def _check_misses(residuals_px: Floats, names: Sequence[str], where: str | Path) -> None:
    misses = np.linalg.norm(residuals_px, axis=1)
    worst = int(np.argmax(misses))
    if misses[worst] > MAX_RESIDUAL_PX:
        what = f"{names[worst]} misses by {misses[worst]:.1f} px: swapped, moved or wrongly detected"
        refuse(what, where, f"residuals up to {MAX_RESIDUAL_PX:g} px", "point_misses")


def _listed(names: Sequence[str], rows: NDArray[np.bool_]) -> str:
    return ", ".join(str(name) for name, row in zip(names, rows, strict=True) if row)
