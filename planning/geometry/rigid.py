"""Rigid motions as poses and as twists.

Notation of Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018), and of `rotations`. A
twist is τ = (ρ, ω): the translation (mm) first, then the rotation (rad). A pose T_b_a = [R, t; 0, 1] maps coordinates
in frame a to frame b. Every function that takes poses (..., 4, 4) takes many at once, unless its shape says otherwise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rotations import exp_rotation


def pose(R: ArrayLike, t: ArrayLike) -> Floats:
    """T (..., 4, 4) of rotations (..., 3, 3), one or as many, and translations (..., 3), mm."""
    t = np.asarray(t, dtype=np.float64)
    T = np.zeros((*t.shape[:-1], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    return T


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
    """A pose (4, 4) turned about a point (3,) of the frame that it leads to, then shifted.

    Args:
        T: Shape (4, 4), mm.
        center: Shape (3,), mm.
        change: Shape (6,): rotation vector (rad), then shift (mm).
    """
    # p -> Exp(ω) (p - c) + c + s
    R = exp_rotation(change[:3])
    return pose(R @ T[:3, :3], R @ (T[:3, 3] - center) + center + change[3:])
