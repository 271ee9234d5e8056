"""How an arm that errs holds its rod: ball and flange, and how each of 26 errors moves them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.error_jacobian import FREE_D, PARAMETERS, erring_arm
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.stereo.servo_law import CarriedRod

FLANGE_ERRORS = PARAMETERS["joint"].stop
"""Of these move the flange: 23."""

N_ROD = PARAMETERS["tip_offset"].stop
"""a1..a6, d1, d3..d6, alpha1..alpha6, six zeros of the joints, the ball on the flange: what moves the ball."""


class RodPoses(NamedTuple):
    """How an arm that errs holds its rod, base frame."""

    ball: Floats
    """Shape (s, 3), mm."""
    slopes: Floats
    """Shape (s, 6, 26): shift of the ball (mm) and turn of the flange (rad) per unit of each parameter's error."""
    R_base_flange: Floats
    """Shape (s, 3, 3)."""


def rod_poses(rod: CarriedRod, eta: Floats, q: Floats) -> RodPoses:
    """Ball and flange at configurations (s, 6), rad, of an arm with errors (26,), mm and rad.

    Each error shifts or turns all that follows it (Mooring, Roth, Driels 1991; `error_jacobian`).
    """
    poses = erring_arm(rod.model, eta[:FLANGE_ERRORS]).link_poses(q)
    origins, axes = poses[..., :3, 3], poses[..., :3, :3]
    R = axes[:, 6]
    ball = origins[:, 6] + R @ (eta[FLANGE_ERRORS:] + np.array([0.0, 0.0, rod.rod_mm]))
    x, z = axes[:, 1:, :, 0], axes[:, :-1, :, 2]
    twist = np.cross(x, ball[:, None] - origins[:, 1:])
    zero = np.cross(z, ball[:, None] - origins[:, :-1])
    slopes = np.zeros((len(q), 6, N_ROD))
    slopes[:, :3] = np.concatenate([x, z[:, list(FREE_D)], twist, zero, R.swapaxes(1, 2)], axis=1).swapaxes(1, 2)
    slopes[:, 3:, PARAMETERS["twist"]] = x.swapaxes(1, 2)
    slopes[:, 3:, PARAMETERS["joint"]] = z.swapaxes(1, 2)
    return RodPoses(ball, slopes, R)
