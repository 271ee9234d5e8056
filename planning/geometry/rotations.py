"""Rotations as rotation vectors: the exponential, the logarithm, and the cross product's matrix.

Notation of Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018). A rotation vector is
ω (rad), Ω = [ω]× its cross-product matrix, φ = |ω|. Every function that takes vectors (..., 3) or rotations (..., 3, 3)
takes many at once, unless its shape says otherwise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.base.arrays import Floats

SMALL_ANGLE = 1e-6
"""rad: below it the left Jacobian's terms of second order (φ²/6 < 2e-13) are left out."""


def skew(v: Floats) -> Floats:
    """The matrix [v]× of vectors (..., 3), shape (..., 3, 3): [v]× a = v × a."""
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return matrix


def exp_rotation(w: ArrayLike) -> Floats:
    """Rotations (..., 3, 3) of rotation vectors (..., 3), rad."""
    # Exp(ω) = I + sin φ / φ Ω + (1 - cos φ) / φ² Ω²   (Solà 2018, Eq. 69); scipy computes it by a unit quaternion
    from scipy.spatial.transform import Rotation  # here: who only moves points does not wait for scipy

    return np.asarray(Rotation.from_rotvec(w).as_matrix())


def log_rotation(R: Floats) -> Floats:
    """Rotation vectors (..., 3), rad, of rotations (..., 3, 3); their length is at most π."""
    # Log(R) = φ (R - R^T)^∨ / (2 sin φ)   (Solà 2018, Eq. 74); scipy computes it by a unit quaternion, near π too
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R).as_rotvec())


def left_jacobian(w: Floats) -> Floats:
    """J_l(ω) with Exp(ω + δ) ≈ Exp(J_l(ω) δ) Exp(ω), shape (3, 3), of one rotation vector (3,), rad."""
    angle = float(np.linalg.norm(w))
    W = skew(w)
    if angle < SMALL_ANGLE:
        return np.asarray(np.eye(3) + W / 2)
    # J_l(ω) = I + (1 - cos φ) / φ² Ω + (φ - sin φ) / φ³ Ω²   (Solà 2018, Eq. 145)
    return np.asarray(np.eye(3) + (1 - np.cos(angle)) / angle**2 * W + (angle - np.sin(angle)) / angle**3 * W @ W)
