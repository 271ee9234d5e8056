"""What a lens does to a pinhole's picture: radial and tangential distortion, its slope, and its inverse.

All points here are normalised: x/z and y/z in the camera's frame, without unit, shape (..., 2). The coefficients are
k1, k2, p1, p2 of Brown's model, in the order and with the signs of OpenCV:

    x_d = x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y_d = y (1 + k1 r^2 + k2 r^4) + p1 (r^2 + 2 y^2) + 2 p2 x y
"""

from __future__ import annotations

import math

import numpy as np

from puncture_twin.planning.base.arrays import Floats

CONVERGED = 1e-14
"""Newton's step, in tangents, that ends the undistortion: 4e-11 px at a focal length of 2560 px."""
MAX_STEPS = 30
"""Newton needs 3 to 6 steps inside the lens's range; more means that no direction leads to this pixel."""


def distort(points: Floats, coefficients: Floats) -> Floats:
    """Where the lens puts normalised points, shape (..., 2)."""
    k1, k2, p1, p2 = coefficients
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + k2 * r2)
    xy = x * y
    return np.stack(
        [x * radial + 2 * p1 * xy + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * xy], axis=-1
    )


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
    found = np.array(points, dtype=np.float64)
    if not np.any(coefficients):
        return found
    step = np.full(found.shape, np.inf)
    for _ in range(MAX_STEPS):
        slope = distortion_slope(found, coefficients)
        miss = points - distort(found, coefficients)
        determinant = slope[..., 0, 0] * slope[..., 1, 1] - slope[..., 0, 1] ** 2
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step[..., 0] = (slope[..., 1, 1] * miss[..., 0] - slope[..., 0, 1] * miss[..., 1]) / determinant
            step[..., 1] = (slope[..., 0, 0] * miss[..., 1] - slope[..., 0, 1] * miss[..., 0]) / determinant
            found += step
        if not np.any(np.abs(step) > CONVERGED):
            break
    r2 = np.sum(found**2, axis=-1)
    with np.errstate(invalid="ignore"):
        true = (np.max(np.abs(step), axis=-1) <= 100 * CONVERGED) & (r2 < fold(coefficients) ** 2)
    return np.where(true[..., None], found, np.nan)


def fold(coefficients: Floats) -> float:
    """Radius (a tangent) at which the picture turns back on itself: beyond it the model means nothing.

    It is the first zero of d(r + k1 r^3 + k2 r^5)/dr; infinite where there is none.
    """
    k1, k2 = float(coefficients[0]), float(coefficients[1])
    square = 9 * k1 * k1 - 20 * k2
    if square < 0:
        return float("inf")
    q = -(3 * k1 + math.copysign(math.sqrt(square), k1)) / 2
    roots = [1 / q if q else 0.0, q / (5 * k2) if k2 else 0.0]
    squares = [root for root in roots if root > 0]
    return float(np.sqrt(min(squares))) if squares else float("inf")
