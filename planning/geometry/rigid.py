"""Rigid motions and rotations: poses, twists, rotation vectors, and frames from axes or points.

Notation of Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018). A twist is τ = (ρ, ω):
the translation (mm) first, then the rotation vector (rad); Ω = [ω]× is its cross-product matrix, φ = |ω|. A pose
T_b_a = [R, t; 0, 1] maps coordinates in frame a to frame b. Every function that takes poses (..., 4, 4), vectors
(..., 3) or rotations (..., 3, 3) takes many at once, unless its shape says otherwise.

Rotations are computed to the last bit as scipy does it, whose import takes 0.04 s in every command. Sines and cosines
are therefore the C library's: numpy's own differ in the last bit.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from puncture_twin.planning.base.arrays import Floats


def pose(R: ArrayLike, t: ArrayLike) -> Floats:
    """T (..., 4, 4) of rotations (..., 3, 3), one or as many, and translations (..., 3), mm."""
    t = np.asarray(t, dtype=np.float64)
    T = np.zeros((*t.shape[:-1], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


def even_directions(count: int) -> Floats:
    """Unit vectors (count, 3) spread evenly over the sphere: a spiral of equal steps in z, each a golden angle on."""
    number = np.arange(count)
    z = 1 - (2 * number + 1) / count
    angle, across = number * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), z])


def inverse(T_b_a: Floats) -> Floats:
    """T_a_b of poses (..., 4, 4)."""
    # T⁻¹ = [R^T, -R^T t; 0, 1]
    T = pose(np.swapaxes(T_b_a[..., :3, :3], -1, -2), np.zeros(T_b_a.shape[:-2] + (3,)))
    T[..., :3, 3] = -(T[..., :3, :3] @ T_b_a[..., :3, 3:])[..., 0]
    return T


def apply(T_b_a: NDArray[np.floating[Any]], points_a: NDArray[np.floating[Any]]) -> Floats:
    """Points (..., 3) of frame a in frame b, by one pose (4, 4), or by any affine map as that of voxels."""
    # p_b = R p_a + t, for points in rows
    return np.asarray(points_a @ T_b_a[:3, :3].T + T_b_a[:3, 3])


def rotated_about(T: Floats, center: Floats, change: Floats) -> Floats:
    """A pose (4, 4) rotated about a point (3,) of the frame that it leads to, then shifted.

    By a change (6,): rotation vector (rad), then shift (mm).
    """
    # p -> Exp(ω) (p - c) + c + s
    R = exp_rotation(change[:3])
    return pose(R @ T[:3, :3], R @ (T[:3, 3] - center) + center + change[3:])


SMALL_ANGLE, SERIES_BELOW = 1e-6, 1e-3
"""rad: below the first the left Jacobian's terms of second order (φ²/6 < 2e-13) are left out; up to the second
sin(φ/2) / φ is its series, off by less than 1e-21."""


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


def _each(function: Callable[[float], float], angles: Floats) -> Floats:
    """The C library's sine or cosine of angles of any shape; not a number of what is not finite."""
    values = [function(angle) if math.isfinite(angle) else math.nan for angle in angles.ravel().tolist()]
    return np.array(values).reshape(angles.shape)


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


def nearest_rotation(M: Floats) -> Floats:
    """The rotation nearest to a matrix (3, 3), in the Frobenius norm; for -M the same as for M where det M < 0."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def left_jacobian(w: Floats) -> Floats:
    """J_l(ω) with Exp(ω + δ) ≈ Exp(J_l(ω) δ) Exp(ω), shape (3, 3), of one rotation vector (3,), rad."""
    angle = float(np.linalg.norm(w))
    W = skew(w)
    if angle < SMALL_ANGLE:
        return np.asarray(np.eye(3) + W / 2)
    # J_l(ω) = I + (1 - cos φ) / φ² Ω + (φ - sin φ) / φ³ Ω²   (Solà 2018, Eq. 145)
    return np.asarray(np.eye(3) + (1 - np.cos(angle)) / angle**2 * W + (angle - np.sin(angle)) / angle**3 * W @ W)


def frame_xz(x: Floats, z: Floats) -> Floats:
    """Rotations with columns x, y = z × x, z, shape (..., 3, 3), of unit vectors (..., 3) at a right angle."""
    return np.stack([x, np.cross(z, x), z], axis=-1)


def frame_yz(y: Floats, z: Floats) -> Floats:
    """Rotations with columns x = y × z, y, z, shape (..., 3, 3), of unit vectors (..., 3) at a right angle."""
    return np.stack([np.cross(y, z), y, z], axis=-1)


def frame_of_axes(z: Floats, x: Floats) -> Floats:
    """The rotation whose z axis lies along one vector (3,) and whose x axis is what of another is square to it."""
    # z = z / |z|,  x = x - z (x · z), made a unit vector: Gram and Schmidt
    z = z / np.linalg.norm(z)
    x = x - z * (x @ z)
    return frame_xz(x / np.linalg.norm(x), z)


def frame_along(z: Floats, down: Floats) -> Floats:
    """The rotation with a unit vector z (3,) as its z axis and x = down × z, made a unit vector; y is nearest to down.

    A camera's frame, where z is its view and ``down`` (3,), not parallel to it, is down in its image.
    """
    x = np.cross(down, z)
    return frame_xz(x / np.linalg.norm(x), z)


def frame_about(z: Floats) -> Floats:
    """Some rotation with a unit vector z (3,) as its z axis; x is square to the base vector farthest from z."""
    return frame_along(z, np.eye(3)[int(np.argmin(np.abs(z)))])


def frame_of_points(points: Floats) -> Floats:
    """Rotations of the frames that three points (..., 3, 3) span (Chen 2019, Eq. 1-6), columns e1, e2, e3."""
    # e1 = (p2 - p1) / |..|,  e3 = e1 × (p3 - p1) / |..|,  e2 = e3 × e1
    e1 = points[..., 1, :] - points[..., 0, :]
    e1 = e1 / np.sqrt(np.vecdot(e1, e1))[..., None]
    e3 = np.cross(e1, points[..., 2, :] - points[..., 0, :])
    return frame_xz(e1, e3 / np.sqrt(np.vecdot(e3, e3))[..., None])
