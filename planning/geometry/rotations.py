"""Rotations as rotation vectors: the exponential, the logarithm, and the cross product's matrix.

What every command needs is computed here, to the last bit as scipy does it, whose import takes 0.04 s. Sines and
cosines are therefore the C library's: numpy's own differ in the last bit.

Notation of Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018). A rotation vector is
ω (rad), Ω = [ω]× its cross-product matrix, φ = |ω|. Every function that takes vectors (..., 3) or rotations (..., 3, 3)
takes many at once, unless its shape says otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.base.arrays import Floats

SMALL_ANGLE = 1e-6
"""rad: below it the left Jacobian's terms of second order (φ²/6 < 2e-13) are left out."""

SERIES_BELOW = 1e-3
"""rad: up to it sin(φ/2) / φ is its series, off by less than 1e-21."""


def skew(v: Floats) -> Floats:
    """The matrix [v]× of vectors (..., 3), shape (..., 3, 3): [v]× a = v × a."""
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return matrix


def exp_rotation(w: ArrayLike) -> Floats:
    """Rotations (..., 3, 3) of rotation vectors (..., 3), rad."""
    # Exp(ω) = I + sin φ / φ Ω + (1 - cos φ) / φ² Ω²   (Solà 2018, Eq. 69), by its unit quaternion
    x, y, z = np.moveaxis(np.asarray(w, dtype=np.float64), -1, 0)
    angle = np.sqrt(x * x + y * y + z * z)
    small = np.where(angle <= SERIES_BELOW, angle, SERIES_BELOW) ** 2
    scale = np.asarray(0.5 - small / 48 + small * small / 3840)
    np.divide(_each(math.sin, angle / 2), angle, out=scale, where=~(angle <= SERIES_BELOW))
    return _of_quaternion(scale * x, scale * y, scale * z, _each(math.cos, angle / 2))


def about_fixed_axes(angles: ArrayLike) -> Floats:
    """Rotations (..., 3, 3) by angles (..., 3), rad, about the fixed axes x, y and z, in this order."""
    half = np.moveaxis(np.asarray(angles, dtype=np.float64), -1, 0) / 2
    (a, b, c), (u, v, w) = _each(math.sin, half), _each(math.cos, half)
    x, y, z, turn = v * a, b * u, -(b * a), v * u  # about x, then y
    return _of_quaternion(w * x - c * y, w * y + c * x, w * z + turn * c, w * turn - c * z)


def _each(of: Callable[[float], float], angles: Floats) -> Floats:
    """The C library's sine or cosine of angles of any shape; not a number of what is not finite."""
    found = [of(angle) if math.isfinite(angle) else math.nan for angle in angles.ravel().tolist()]
    return np.array(found).reshape(angles.shape)


def _of_quaternion(x: Floats, y: Floats, z: Floats, w: Floats) -> Floats:
    """Rotations (..., 3, 3) of unit quaternions, each part (...); w is the scalar one."""
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    xy, zw, xz, yw, yz, xw = x * y, z * w, x * z, y * w, y * z, x * w
    rows = (
        *(xx - yy - zz + ww, 2 * (xy - zw), 2 * (xz + yw)),
        *(2 * (xy + zw), -xx + yy - zz + ww, 2 * (yz - xw)),
        *(2 * (xz - yw), 2 * (yz + xw), -xx - yy + zz + ww),
    )
    return np.stack(rows, axis=-1).reshape(*np.shape(x), 3, 3)


def log_rotation(R: Floats) -> Floats:
    """Rotation vectors (..., 3), rad, of rotations (..., 3, 3); their length is at most π."""
    # Log(R) = φ (R - R^T)^∨ / (2 sin φ)   (Solà 2018, Eq. 74); scipy computes it by a unit quaternion, near π too
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R).as_rotvec())


def rotation_angle(R: Floats) -> float:
    """The angle of one rotation (3, 3), rad, from 0 to π; near π it is off by 1e-8 at most."""
    # |(R - R^T)^∨| = 2 sin φ and tr R = 1 + 2 cos φ
    twice_sine = math.hypot(R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    return math.atan2(twice_sine, float(np.trace(R)) - 1.0)


def left_jacobian(w: Floats) -> Floats:
    """J_l(ω) with Exp(ω + δ) ≈ Exp(J_l(ω) δ) Exp(ω), shape (3, 3), of one rotation vector (3,), rad."""
    angle = float(np.linalg.norm(w))
    W = skew(w)
    if angle < SMALL_ANGLE:
        return np.asarray(np.eye(3) + W / 2)
    # J_l(ω) = I + (1 - cos φ) / φ² Ω + (φ - sin φ) / φ³ Ω²   (Solà 2018, Eq. 145)
    return np.asarray(np.eye(3) + (1 - np.cos(angle)) / angle**2 * W + (angle - np.sin(angle)) / angle**3 * W @ W)
