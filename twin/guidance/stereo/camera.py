"""Camera model: the pixel of a point of the calibration frame C, the ray of a pixel, and the lens's distortion.

Pixel (u, v) is column and row; **pixel centres are at integers**, so the image spans -0.5 .. width - 0.5. The
camera's frame is the field's: x right, y down, z forward. Distortion is Brown's k1, k2, p1, p2, in the order and with
the signs of OpenCV, of normalised points x/z and y/z in the camera's frame, without unit, shape (..., 2):

    x_d = x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y_d = y (1 + k1 r^2 + k2 r^4) + p1 (r^2 + 2 y^2) + 2 p2 x y
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.rigid import apply, frame_about, frame_along, pose

ROTATION_TOLERANCE = 1e-6
"""How far R^T R may be from the identity: a rotation typed with seven digits passes, a scaled one does not."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera in the frame C: size, focal lengths and principal point in px, column before row."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Floats  # k1, k2, p1, p2
    T_camera_c: Floats  # shape (4, 4), mm, rigid: frame C to the camera's frame

    def __post_init__(self) -> None:
        for name, shape in (("distortion", (4,)), ("T_camera_c", (4, 4))):
            array = read_only(getattr(self, name))
            if array.shape != shape or not np.isfinite(array).all():
                refuse(f"{name} has shape {array.shape} or is not finite", "camera", str(shape), "wrong_shape")
            object.__setattr__(self, name, array)
        sizes = (self.width, self.height, self.fx, self.fy)
        if not (np.isfinite([*sizes, self.cx, self.cy]).all() and min(sizes) > 0):
            refuse(f"size and focal length {sizes}", "camera", "finite and above 0", "not_positive")
        R = self.T_camera_c[:3, :3]
        if np.abs(R.T @ R - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
            refuse("T_camera_c is not rigid", "camera", "a rotation and a translation", "not_rigid")

    @property
    def center_c(self) -> Floats:
        """The centre of projection in C, shape (3,), mm."""
        return np.asarray(-self.T_camera_c[:3, :3].T @ self.T_camera_c[:3, 3])

    @property
    def K(self) -> Floats:  # noqa: N802
        """The intrinsic matrix, shape (3, 3), px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points_c: Floats) -> Floats:
        """Pixels (..., 2) of points (..., 3), mm; NaN behind the camera and beyond the lens's range."""
        points = apply(self.T_camera_c, np.asarray(points_c, dtype=np.float64))
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = np.where(points[..., 2:] > 0, points[..., :2] / points[..., 2:], np.nan)
            flat = np.where(np.sum(flat**2, axis=-1, keepdims=True) < fold(self.distortion) ** 2, flat, np.nan)
        return np.asarray(distort(flat, self.distortion) * [self.fx, self.fy] + [self.cx, self.cy])

    def jacobian(self, points_c: Floats) -> Floats:
        """Derivative of ``project`` by the point, shape (..., 2, 3), px/mm."""
        points = apply(self.T_camera_c, np.asarray(points_c, dtype=np.float64))
        slope = distortion_slope(points[..., :2] / points[..., 2:], self.distortion)
        flat = np.zeros((*points.shape[:-1], 2, 3))
        flat[..., 0, 0] = flat[..., 1, 1] = 1 / points[..., 2]
        flat[..., :2, 2] = -points[..., :2] / points[..., 2:] ** 2
        return np.asarray(np.array([self.fx, self.fy])[:, None] * (slope @ flat @ self.T_camera_c[:3, :3]))

    def rays(self, pixels: Floats) -> Floats:
        """Unit directions (..., 3), in C, from the centre through pixels (..., 2); NaN where the lens has no ray."""
        flat = (np.asarray(pixels, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        flat = undistort(flat, self.distortion)
        directions = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1) @ self.T_camera_c[:3, :3]
        return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))

    def sees(self, pixels: Floats, margin_px: float = 0.0) -> NDArray[np.bool_]:
        """Pixels (..., 2) that lie in the image, at least a margin from its border; NaN does not."""
        low = margin_px - 0.5
        high = np.array([self.width, self.height]) - 0.5 - margin_px
        with np.errstate(invalid="ignore"):
            return np.asarray(np.all((pixels >= low) & (pixels <= high), axis=-1))

    def ball_radius_px(self, point_c: Floats, radius_mm: float) -> float:
        """Radius of the circle as large as a ball's outline: sqrt of the two half axes' product, px; centre (3,), mm.

        A ball of radius R at distance D fills a cone of half angle asin(R / D); the local scale takes it to pixels.
        """
        toward = np.asarray(point_c, dtype=np.float64) - self.center_c
        distance = float(np.linalg.norm(toward))
        return float(np.arcsin(radius_mm / distance)) * self.local_scale(toward / distance)

    def local_scale(self, direction_c: Floats) -> float:
        """Pixels per radian around a direction (3,): the root of the area's magnification."""
        return float(np.sqrt(abs(np.linalg.det(self.angle_slope(direction_c)))))

    def angle_slope(self, direction_c: Floats) -> Floats:
        """Derivative of the pixel by a rotation of the ray about each of the ``tangent_axes``, shape (2, 2), px/rad."""
        return np.asarray(self.jacobian(self.center_c + direction_c) @ tangent_axes(direction_c))

    def pinhole(self) -> Camera:
        """The camera with a perfect lens."""
        return replace(self, distortion=np.zeros(4))


def tangent_axes(direction: Floats) -> Floats:
    """Two unit vectors across a unit direction (3,), as columns, shape (3, 2); the three are right-handed."""
    return frame_about(direction)[:, :2]


DOWN_C = (0.0, 1.0, 0.0)
"""What is down in an image: y of C."""
NO_LENS = (0.0, 0.0, 0.0, 0.0)


def looking_at(
    centre_c: Floats, target_c: Floats, size: tuple[int, int], focal_px: float, distortion: Sequence[float] = NO_LENS
) -> Camera:
    """A camera at a place (3,), mm, in C with a point (3,) in the middle of its image; size in px, columns first."""
    z = np.asarray(target_c, dtype=np.float64) - centre_c
    R = np.ascontiguousarray(frame_along(z / np.linalg.norm(z), np.array(DOWN_C)).T)
    T, (width, height) = pose(R, -R @ np.asarray(centre_c, dtype=np.float64)), size
    middle = (width - 1) / 2, (height - 1) / 2
    return Camera(width, height, focal_px, focal_px, *middle, np.asarray(distortion, dtype=np.float64), T)


def stereo_pair(
    width: int, height: int, focal_px: float, baseline_mm: float, distance_mm: float, lens: Sequence[float] = NO_LENS
) -> tuple[Camera, Camera]:
    """Left and right camera, side by side, both looking at the workcell's centre.

    The centre is C's origin; x runs from the left camera to the right one, y down, z away from them. The cameras stand
    at (-+ baseline / 2, 0, -distance).
    """
    left, right = (np.array([x, 0.0, -distance_mm]) for x in (-baseline_mm / 2, baseline_mm / 2))
    target, size = np.zeros(3), (width, height)
    return looking_at(left, target, size, focal_px, lens), looking_at(right, target, size, focal_px, lens)


CONVERGED = 1e-14
"""Newton's step, in tangents, that ends the undistortion: 4e-11 px at a focal length of 2560 px."""
MAX_STEPS = 30
"""Newton needs 3 to 6 steps inside the lens's range; more means that no direction leads to this pixel."""


def distort(points: Floats, coefficients: Floats) -> Floats:
    """Distorted normalised points, shape (..., 2)."""
    k1, k2, p1, p2 = coefficients
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + k2 * r2)
    xy = x * y
    bent_x = x * radial + 2 * p1 * xy + p2 * (r2 + 2 * x * x)
    return np.stack([bent_x, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * xy], axis=-1)


def distortion_slope(points: Floats, coefficients: Floats) -> Floats:
    """Derivative of ``distort`` by the point, shape (..., 2, 2); it is symmetric."""
    k1, k2, p1, p2 = coefficients
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + k2 * r2)
    growth = 2 * (k1 + 2 * k2 * r2)
    across = growth * x * y + 2 * p1 * x + 2 * p2 * y
    slope = np.empty((*points.shape[:-1], 2, 2))
    slope[..., 0, 0] = radial + growth * x * x + 2 * p1 * y + 6 * p2 * x
    slope[..., 1, 1] = radial + growth * y * y + 6 * p1 * y + 2 * p2 * x
    slope[..., 0, 1] = slope[..., 1, 0] = across
    return slope


def coefficient_slope(points: Floats) -> Floats:
    """Derivative of ``distort`` by (k1, k2, p1, p2), shape (..., 2, 4)."""
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    by_x = np.stack([x * r2, x * r2 * r2, 2 * x * y, r2 + 2 * x * x], axis=-1)
    by_y = np.stack([y * r2, y * r2 * r2, r2 + 2 * y * y, 2 * x * y], axis=-1)
    return np.stack([by_x, by_y], axis=-2)


def undistort(points: Floats, coefficients: Floats) -> Floats:
    """Inverse of ``distort`` by Newton, shape (..., 2); NaN where the lens sends no direction to."""
    undistorted = np.array(points, dtype=np.float64)
    if not np.any(coefficients):
        return undistorted
    step = np.full(undistorted.shape, np.inf)
    for _ in range(MAX_STEPS):
        slope = distortion_slope(undistorted, coefficients)
        miss = points - distort(undistorted, coefficients)
        determinant = slope[..., 0, 0] * slope[..., 1, 1] - slope[..., 0, 1] ** 2
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step[..., 0] = (slope[..., 1, 1] * miss[..., 0] - slope[..., 0, 1] * miss[..., 1]) / determinant
            step[..., 1] = (slope[..., 0, 0] * miss[..., 1] - slope[..., 0, 1] * miss[..., 0]) / determinant
            undistorted += step  # a 2 x 2 system by Cramer's rule
        if not np.any(np.abs(step) > CONVERGED):
            break
    r2 = np.sum(undistorted**2, axis=-1)
    with np.errstate(invalid="ignore"):
        unique = (np.max(np.abs(step), axis=-1) <= 100 * CONVERGED) & (r2 < fold(coefficients) ** 2)
    return np.where(unique[..., None], undistorted, np.nan)


def fold(coefficients: Floats) -> float:
    """Radius (a tangent) at which the image folds back on itself: beyond it the model is meaningless.

    It is the first zero of d(r + k1 r^3 + k2 r^5)/dr; infinite where there is none.
    """
    k1, k2 = float(coefficients[0]), float(coefficients[1])
    square = 9 * k1 * k1 - 20 * k2
    if square < 0:
        return float("inf")
    q = -(3 * k1 + math.copysign(math.sqrt(square), k1)) / 2  # without cancellation
    roots = [1 / q if q else 0.0, q / (5 * k2) if k2 else 0.0]
    squares = [root for root in roots if root > 0]
    return float(np.sqrt(min(squares))) if squares else float("inf")
