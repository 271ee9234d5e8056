"""Where the needle truly is, for many arms at once, each with errors of its own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.error_jacobian import FREE_D, N_PARAMETERS, PARAMETERS, dh_step, error_jacobian
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rotations import exp_rotation

NEWTON_STEPS = 4
"""Of a tip moved onto a point: errors of an arm are millimetres, and each step squares what is left of them."""


class TrueNeedle(NamedTuple):
    """A needle: its tip, shape (..., 3), mm, and its axes as columns, shape (..., 3, 3); z points to the tip."""

    tip_base: Floats
    R_base_needle: Floats


def true_needle(model: UrModel, q_true: Floats, eta: Floats, tip_mm: float) -> TrueNeedle:
    """The needle of arms whose 28 parameters err.

    Args:
        model: The nominal arm.
        q_true: Shape (..., 6), rad: what the joints truly are, but for the error of their zeros.
        eta: Shape (..., 28), the errors in the order of `error_jacobian`'s columns, mm and rad.
        tip_mm: Flange to tip by the controller's number.
    """
    eta = np.broadcast_to(eta, (*q_true.shape[:-1], N_PARAMETERS))
    a = np.array(model.a) + eta[..., 0:6]
    d = np.broadcast_to(np.array(model.d), a.shape).copy()
    d[..., list(FREE_D)] += eta[..., 6:11]
    alpha = np.array(model.alpha) + eta[..., PARAMETERS["twist"]]
    q = q_true + eta[..., PARAMETERS["joint"]]
    T = dh_step(q[..., 0], d[..., 0], a[..., 0], alpha[..., 0])
    for joint in range(1, 6):
        T = T @ dh_step(q[..., joint], d[..., joint], a[..., joint], alpha[..., joint])
    R = T[..., :3, :3]
    offset = eta[..., PARAMETERS["tip_offset"]] + np.array([0.0, 0.0, tip_mm])
    lean = np.concatenate([eta[..., PARAMETERS["needle_direction"]], np.zeros((*eta.shape[:-1], 1))], axis=-1)
    return TrueNeedle(T[..., :3, 3] + (R @ offset[..., None])[..., 0], R @ exp_rotation(lean))


def driven_onto(model: UrModel, points_base: Floats, q_start: Floats, eta: Floats, tip_mm: float) -> Floats:
    """True joints that put each true tip on its point, shape (..., 6), rad, nearest to where they start.

    Args:
        model: The nominal arm.
        points_base: Shape (..., 3), mm.
        q_start: Shape (..., 6), rad: such as what would do for the nominal arm.
        eta: Shape (..., 28).
        tip_mm: Flange to tip by the controller's number.
    """
    q = np.array(np.broadcast_to(q_start, (*points_base.shape[:-1], 6)))
    Jq = error_jacobian(model, q_start, tip_mm)[..., :3, PARAMETERS["joint"]]  # Newton's with the nominal arm's slope
    back = np.linalg.pinv(Jq)
    for _ in range(NEWTON_STEPS):
        missing = points_base - true_needle(model, q, eta, tip_mm).tip_base
        q += (back @ missing[..., None])[..., 0]
    return q
