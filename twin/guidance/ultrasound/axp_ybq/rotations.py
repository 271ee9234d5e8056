"""Small pieces of the rotation group, for many vectors at once."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from puncture_twin.planning.base.arrays import Floats


def skew(w: Floats) -> Floats:
    """[w]x of vectors (..., 3), shape (..., 3, 3): [w]x a = w x a."""
    matrix = np.zeros((*w.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    matrix[..., 1, 0], matrix[..., 2, 0], matrix[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return matrix


def exp(w: Floats) -> Floats:
    """Rotations (..., 3, 3) of rotation vectors (..., 3), rad: the exponential of [w]x."""
    return np.asarray(Rotation.from_rotvec(w).as_matrix())


def log(R: Floats) -> Floats:
    """Rotation vectors (..., 3), rad, of rotations (..., 3, 3)."""
    return np.asarray(Rotation.from_matrix(R).as_rotvec())


def tangent_basis(direction: Floats) -> Floats:
    """Two unit vectors across a direction (3,) and each other, as columns, shape (3, 2)."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = skew(direction) @ helper
    first /= np.linalg.norm(first)
    return np.column_stack([first, skew(direction) @ first])
