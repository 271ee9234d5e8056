"""How the errors of an arm and of the needle on it move the needle: 28 parameters, by Denavit and Hartenberg.

Source: Mooring, Roth, Driels, "Fundamentals of Manipulator Calibration", 1991: one column a parameter, its axis times
its lever. With z_{i-1}, o_{i-1} axis and origin of joint i, and x_i, o_i of the frame behind it, at the tip p:

    a_i: (x_i; 0)   d_i: (z_{i-1}; 0)   alpha_i: (x_i x (p - o_i); x_i)   q_i: (z_{i-1} x (p - o_{i-1}); z_{i-1})
    tip offset: (R_flange; 0)   needle direction: (0; first two columns of R_flange)

d2 is left out: axes 2 and 3 are parallel, and d3 moves the arm alike.

Kinematics of an arm whose Denavit-Hartenberg numbers are not the nominal ones.

T_{i-1}_{i} = Rz(q_i + zero_i) Tz(d_i) Tx(a_i) Rx(alpha_i). The parameters that err, and their order, are the first 23
of `error_jacobian`. A calibration estimates such an arm, a twin draws one.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats

N_PARAMETERS = 28

PARAMETERS: Mapping[str, slice] = MappingProxyType(
    {
        "link": slice(0, 11),
        "twist": slice(11, 17),
        "joint": slice(17, 23),
        "tip_offset": slice(23, 26),
        "needle_direction": slice(26, 28),
    }
)
"""Which columns belong to which kind: a1..a6 and d1, d3..d6; alpha1..6; zeros q1..6; flange axes; flange x and y."""

FREE_D = (0, 2, 3, 4, 5)
"""Indices of the link offsets that are parameters."""


def error_jacobian(model: UrModel, q: Floats, tip_mm: float) -> Floats:
    """The needle's motion per unit of each parameter's error.

    Args:
        model: The nominal arm.
        q: Shape (..., 6), rad.
        tip_mm: Flange to tip, along the flange's z.

    Returns:
        Shape (..., 6, 28), base frame: rows 0-2 the tip in mm, rows 3-5 the rotation in rad; per mm of a length or an
        offset, per rad of an angle.
    """
    frames = link_poses(model, q)
    R_flange = frames[..., 6, :3, :3]
    tip = frames[..., 6, :3, 3] + tip_mm * R_flange[..., 2]
    x, at_x = np.moveaxis(frames[..., 1:, :3, 0], -2, -1), frames[..., 1:, :3, 3]
    z, at_z = np.moveaxis(frames[..., :6, :3, 2], -2, -1), frames[..., :6, :3, 3]
    J = np.zeros((*np.shape(q)[:-1], 6, N_PARAMETERS))
    J[..., :3, 0:6] = x
    J[..., :3, 6:11] = z[..., list(FREE_D)]
    J[..., :3, PARAMETERS["twist"]] = _levers(x, tip, at_x)
    J[..., 3:, PARAMETERS["twist"]] = x
    J[..., :3, PARAMETERS["joint"]] = _levers(z, tip, at_z)
    J[..., 3:, PARAMETERS["joint"]] = z
    J[..., :3, PARAMETERS["tip_offset"]] = R_flange
    J[..., 3:, PARAMETERS["needle_direction"]] = R_flange[..., :2]
    return J


def _levers(axes: Floats, tip: Floats, origins: Floats) -> Floats:
    """The axis x (tip - origin) in columns, shape (..., 3, 6)."""
    levers = tip[..., :, None] - np.moveaxis(origins, -2, -1)
    return np.asarray(np.cross(axes, levers, axisa=-2, axisb=-2, axisc=-2))


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
