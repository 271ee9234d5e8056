"""Kinematics of an arm whose Denavit-Hartenberg numbers are not the nominal ones.

T_{i-1}_{i} = Rz(q_i + zero_i) Tz(d_i) Tx(a_i) Rx(alpha_i). The parameters that err, and their order, are the first 23
of `error_jacobian`. A calibration estimates such an arm, a twin draws one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.error_jacobian import FREE_D, PARAMETERS
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats


class ErringArm(NamedTuple):
    """Denavit-Hartenberg numbers of one arm, each of shape (6,), mm and rad."""

    a: Floats
    d: Floats
    alpha: Floats
    zeros: Floats
    """True zero minus nominal zero of each joint."""

    def link_poses(self, q: Floats) -> Floats:
        """T_base_link, shape (..., 7, 4, 4), mm, of configurations (..., 6), rad: base first, flange last."""
        q = np.asarray(q, dtype=np.float64) + self.zeros
        poses = np.empty((*q.shape[:-1], 7, 4, 4))
        poses[..., 0, :, :] = np.eye(4)
        for i in range(6):
            step = dh_step(q[..., i], self.d[i], self.a[i], self.alpha[i])
            poses[..., i + 1, :, :] = poses[..., i, :, :] @ step
        return poses


def erring_arm(nominal: UrModel, eta: Floats) -> ErringArm:
    """The nominal arm with its errors (23,), mm and rad: a1..a6, d1, d3..d6, alpha1..alpha6, zeros of q1..q6."""
    d = np.array(nominal.d)
    d[list(FREE_D)] += eta[6:11]
    alpha = np.array(nominal.alpha) + eta[PARAMETERS["twist"]]
    return ErringArm(np.array(nominal.a) + eta[:6], d, alpha, np.asarray(eta[PARAMETERS["joint"]]))


def dh_step(q: Floats, d: Floats | float, a: Floats | float, alpha: Floats | float) -> Floats:
    """T_{i-1}_{i} = Rz(q) Tz(d) Tx(a) Rx(alpha), shape (..., 4, 4), of angles (...); d, a, alpha: as many, or one."""
    c, s, ca, sa = np.cos(q), np.sin(q), np.cos(alpha), np.sin(alpha)
    T = np.zeros((*np.shape(q), 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2], T[..., 0, 3] = c, -s * ca, s * sa, a * c
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2], T[..., 1, 3] = s, c * ca, -c * sa, a * s
    T[..., 2, 1], T[..., 2, 2], T[..., 2, 3] = sa, ca, d
    T[..., 3, 3] = 1.0
    return T
