"""What every pose says of the tip: residuals of A X P = Y B Q and their Jacobian.

F = R_Y (R_B t_Q + t_B) + t_Y - R_A (R_X S p + t_X) - t_A (mm, base1), S = diag(scale).
With R <- R exp([w]x) its derivatives by w_X, t_X, w_Y, t_Y, t_Q, scale are
R_A R_X [S p]x, -R_A, -R_Y [R_B t_Q + t_B]x, I, R_Y R_B, -R_A R_X[:, :2] diag(u, v).
(Spec 3, section 2. The patent prints the first and third without their signs; its G is -J.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rotations import skew
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.parameters import N_PARAMETERS, SCALE, T_Q, T_X, T_Y, W_X, W_Y
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
