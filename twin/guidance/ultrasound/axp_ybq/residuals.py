"""What every pose says of tip and direction: residuals of A X P = Y B Q and their Jacobians.

F = R_Y (R_B t_Q + t_B) + t_Y - R_A (R_X S p + t_X) - t_A (mm, base1), S = diag(scale).
With R <- R exp([w]x) its derivatives by w_X, t_X, w_Y, t_Y, t_Q, scale are
R_A R_X [S p]x, -R_A, -R_Y [R_B t_Q + t_B]x, I, R_Y R_B, -R_A R_X[:, :2] diag(u, v).
(Spec 3, section 2. The patent prints the first and third without their signs; its G is -J.)

m = M V with the rotation M = (R_A R_X)^T R_Y R_B from end2 to image. Two residuals: how far m points away from the
measured v inside the image, and across it: e1.m and e2.m, e1 = z x v made unit and e2 = v x e1.
dm = [m]x w_X - (R_A R_X)^T R_Y [R_B V]x w_Y + M dV.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.geometry.rotations import skew
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import (
    DIRECTION,
    N_PARAMETERS,
    SCALE,
    T_Q,
    T_X,
    T_Y,
    W_X,
    W_Y,
    Estimate,
    tangent_basis,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording


class Linearised(NamedTuple):
    """Residuals and their derivatives."""

    residuals: Floats
    """Shape (n, k)."""
    jacobian: Floats
    """Shape (n, k, 19), by the parameters of ``parameters.PARAMETERS``."""


def linearised_tip(estimate: Estimate, recording: Recording) -> Linearised:
    """The tip's residuals with their Jacobian."""
    n, r = len(recording), tip_residuals(estimate, recording)
    R_A, R_AX = recording.A[:, :3, :3], recording.A[:, :3, :3] @ estimate.R_X
    p = np.column_stack([recording.P * estimate.scale, np.zeros(n)])
    _, in_base2 = tip_points(estimate, recording)
    J = np.zeros((n, 3, N_PARAMETERS))
    J[:, :, W_X] = R_AX @ skew(p)
    J[:, :, T_X] = -R_A
    J[:, :, W_Y] = -estimate.R_Y @ skew(in_base2)
    J[:, :, T_Y] = np.eye(3)
    J[:, :, T_Q] = estimate.R_Y @ recording.B[:, :3, :3]
    J[:, :, SCALE] = -R_AX[:, :, :2] * recording.P[:, None, :]
    return Linearised(r, J)


def tip_residuals(estimate: Estimate, recording: Recording) -> Floats:
    """F = Y B Q - A X P, shape (n, 3), mm, base1."""
    in_end1, in_base2 = tip_points(estimate, recording)
    by_probe = (recording.A[:, :3, :3] @ in_end1[:, :, None])[:, :, 0] + recording.A[:, :3, 3]
    return np.asarray(in_base2 @ estimate.R_Y.T + estimate.t_Y - by_probe)


def tip_points(estimate: Estimate, recording: Recording) -> tuple[Floats, Floats]:
    """The tip in end1, as the image says, and in base2, as the needle's arm says; both (n, 3), mm."""
    in_end1 = (recording.P * estimate.scale) @ estimate.R_X[:, :2].T + estimate.t_X
    in_base2 = recording.B[:, :3, :3] @ estimate.t_Q + recording.B[:, :3, 3]
    return in_end1, in_base2


def linearised_direction(estimate: Estimate, recording: Recording, v_image: Floats) -> Linearised:
    """The direction's residuals (n, 2), rad for small ones, with their Jacobian.

    Args:
        estimate: Where to linearise.
        recording: The poses.
        v_image: The measured directions, unit, shape (n, 3).
    """
    M = needle_in_image(estimate, recording)
    m = M @ estimate.V
    rows = across(v_image)
    R_AXY = (recording.A[:, :3, :3] @ estimate.R_X).transpose(0, 2, 1) @ estimate.R_Y
    J = np.zeros((len(recording), 2, N_PARAMETERS))
    J[:, :, W_X] = rows @ skew(m)
    J[:, :, W_Y] = -rows @ R_AXY @ skew(recording.B[:, :3, :3] @ estimate.V)
    J[:, :, DIRECTION] = rows @ M @ tangent_basis(estimate.V)
    return Linearised((rows @ m[:, :, None])[:, :, 0], J)


def direction_residuals(estimate: Estimate, recording: Recording, v_image: Floats) -> Floats:
    """The direction's residuals alone, shape (n, 2)."""
    return np.asarray(across(v_image) @ needle_in_image(estimate, recording) @ estimate.V)


def needle_in_image(estimate: Estimate, recording: Recording) -> Floats:
    """M = (R_A R_X)^T R_Y R_B, the rotation from end2 to image, shape (n, 3, 3)."""
    R_AX = recording.A[:, :3, :3] @ estimate.R_X
    return np.asarray(R_AX.transpose(0, 2, 1) @ estimate.R_Y @ recording.B[:, :3, :3])


def directions_image(recording: Recording, estimate: Estimate) -> Floats:
    """The measured directions in mm, as unit vectors (n, 3); one that was measured in the image only has z = 0.

    Raises:
        ValueError: The recording holds no directions.
    """
    if recording.v is None:
        raise ValueError("the recording holds no directions")
    v = np.zeros((len(recording), 3))
    v[:, : recording.v.shape[1]] = recording.v
    v[:, :2] *= estimate.scale
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def directions_end2(estimate: Estimate, recording: Recording) -> Floats:
    """The measured directions as every pose has them in end2, M^T v: shape (n, 3), unit."""
    back = needle_in_image(estimate, recording).transpose(0, 2, 1)
    return np.asarray(np.einsum("nij,nj->ni", back, directions_image(recording, estimate)))


def across(v: Floats) -> Floats:
    """e1 (inside the image, across v) and e2 (across the image) of unit vectors (n, 3), as rows: shape (n, 2, 3)."""
    rows = np.zeros((len(v), 2, 3))
    a, b, c = v.T
    flat = np.hypot(a, b)
    rows[:, 0, 0], rows[:, 0, 1] = -b / flat, a / flat
    rows[:, 1, 0], rows[:, 1, 1], rows[:, 1, 2] = -a * c / flat, -b * c / flat, flat
    return rows


def facing(estimate: Estimate, recording: Recording) -> Bools:
    """Whether a pose's measured direction points the way of V at all, shape (n,): one turned round has no residual."""
    m = needle_in_image(estimate, recording) @ estimate.V
    return np.asarray(np.einsum("ni,ni->n", m, directions_image(recording, estimate)) > 0)
