"""How the errors of an arm and of the needle on it move the needle: 28 parameters, by Denavit and Hartenberg.

Source: Mooring, Roth, Driels, "Fundamentals of Manipulator Calibration", 1991: one column a parameter, its axis times
its lever. With z_{i-1}, o_{i-1} axis and origin of joint i, and x_i, o_i of the frame behind it, at the tip p:

    a_i: (x_i; 0)   d_i: (z_{i-1}; 0)   alpha_i: (x_i x (p - o_i); x_i)   q_i: (z_{i-1} x (p - o_{i-1}); z_{i-1})
    tip offset: (R_flange; 0)   needle direction: (0; first two columns of R_flange)

d2 is left out: axes 2 and 3 are parallel, and d3 moves the arm alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

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
