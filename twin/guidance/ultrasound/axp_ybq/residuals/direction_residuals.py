"""What every pose says of the needle's direction: residuals and their Jacobian.

m = M V with the rotation M = (R_A R_X)^T R_Y R_B from end2 to image. Two residuals: how far m points away from the
measured v inside the image, and across it: e1.m and e2.m, e1 = z x v made unit and e2 = v x e1.
dm = [m]x w_X - (R_A R_X)^T R_Y [R_B V]x w_Y + M dV.
"""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.geometry.rotations import skew
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import Estimate, tangent_basis
from puncture_twin.twin.guidance.ultrasound.axp_ybq.parameters import DIRECTION, N_PARAMETERS, W_X, W_Y
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals.tip_residuals import Linearised


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
