"""The linear map from reading errors to the pose that each method makes of them.

With A_i = [I, -[p_i - c]x] stacked and weights W, a reading error z moves the fitted pose by L z, L = (A' W A)^-1 A' W:
a shift of the centroid c, then a rotation about it, base axes. The weighted fit is Gauss-Newton along this map:
Moghari, Abolmaesumi, IEEE TMI 26(12), 2007; Danilchenko, Fitzpatrick, IEEE TMI 30(3), 2011.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.rotations import log_rotation, skew

NUDGE_MM = 1e-4
"""Of central differences of a method that has no formula of its own; their error is 1e-9 of the map."""


def design(points_base: Floats, center_base: Floats) -> Floats:
    """A, shape (3 N, 6), of points (N, 3) about a centre (3,): how a shift and a rotation (rad) move them."""
    return design_blocks(points_base, center_base).reshape(-1, 6)


def least_squares_map(A: Floats, weights: Floats | None = None) -> Floats:
    """L, shape (6, 3 N), of a design (3 N, 6) and weights (3 N, 3 N); None weighs all alike."""
    weighted = A.T if weights is None else A.T @ weights
    return np.asarray(np.linalg.solve(weighted @ A, weighted))


def design_blocks(points: Floats, center: Floats) -> Floats:
    """A_i = [I, -[p_i - c]x], shape (..., N, 3, 6)."""
    eye = np.broadcast_to(np.eye(3), (*points.shape, 3))
    return np.concatenate([eye, -skew(points - center[..., None, :])], axis=-1)


def differenced_map(fit: Callable[[Floats, Floats], Floats], points_ct: Floats, points_base: Floats) -> Floats:
    """L, shape (6, 3 N), of any method, by central differences of its pose over the base readings."""
    center = points_base.mean(axis=0)
    T = fit(points_ct, points_base)
    columns = []
    for k in range(points_base.size):
        nudge = np.zeros(points_base.size)
        nudge[k] = NUDGE_MM
        moved = [fit(points_ct, points_base + sign * nudge.reshape(-1, 3)) for sign in (1.0, -1.0)]
        back = np.linalg.inv(T)
        shift = (apply(moved[0], apply(back, center)) - apply(moved[1], apply(back, center))) / (2 * NUDGE_MM)
        turn = log_rotation(moved[0][:3, :3] @ moved[1][:3, :3].T) / (2 * NUDGE_MM)
        columns.append(np.concatenate([shift, turn]))
    return np.array(columns).T


def carried(center_base: Floats, point_base: Floats) -> Floats:
    """X, shape (6, 6): a shift and rotation about a centre (3,) as they arrive at another point (3,)."""
    X = np.eye(6)
    X[:3, 3:] = -skew(point_base - center_base)
    return X
