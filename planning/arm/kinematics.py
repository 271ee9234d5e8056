"""Forward kinematics of the UR arms: frames of the links, and the Jacobian.

The base frame is the controller's (a URDF's ``base_link`` is rotated by 180 deg about z against it). Frames follow
Denavit and Hartenberg: T_{i-1}_{i} = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i). Compiled loops take an arm as its lengths
(d1, a2, a3, d4, d5, d6) in mm.
"""

from __future__ import annotations

import math

import numpy as np

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import allocation_free


def _rows(q: Floats) -> Floats:
    """Configurations (..., 6) as one new (n, 6): a copy, since read-only arrays would be compiled for once more."""
    return np.array(q, dtype=np.float64, order="C").reshape(-1, 6)


def link_poses(model: UrModel, q: Floats) -> Floats:
    """Frames of the base and the six links.

    Args:
        model: The arm.
        q: Shape (..., 6), rad.

    Returns:
        T_base_link, shape (..., 7, 4, 4), mm: the base (identity) first, the flange last.
    """
    rows = _rows(q)
    poses = np.empty((len(rows), 7, 4, 4))
    link_frames(model.lengths, rows, poses)
    return poses.reshape(*np.shape(q)[:-1], 7, 4, 4)


@allocation_free()
def link_frames(lengths, q, frames):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``frames`` (n, 7, 4, 4) from ``q`` (n, 6)."""
    d1, a2, a3, d4, d5, d6 = lengths
    for row in range(len(q)):
        frames[row] = 0.0
        for link in range(7):
            frames[row, link, 3, 3] = 1.0
        for i in range(3):
            frames[row, 0, i, i] = 1.0
        for joint in range(6):
            a = a2 if joint == 1 else (a3 if joint == 2 else 0.0)
            d = d1 if joint == 0 else (d4 if joint == 3 else (d5 if joint == 4 else (d6 if joint == 5 else 0.0)))
            sa = 1.0 if joint in (0, 3) else (-1.0 if joint == 4 else 0.0)
            ca = 1.0 if sa == 0.0 else 0.0
            c, s = math.cos(q[row, joint]), math.sin(q[row, joint])
            _next_frame(frames[row, joint], frames[row, joint + 1], c, s, a, d, ca, sa)


@allocation_free()
def _next_frame(before, after, c, s, a, d, ca, sa):  # type: ignore[no-untyped-def]  # numba infers
    """``after`` = ``before`` Rz Tz(d) Tx(a) Rx, with cosine and sine of the joint and of the twist."""
    for i in range(3):
        x, y, z = before[i, 0], before[i, 1], before[i, 2]
        along = c * x + s * y
        across = c * y - s * x
        after[i, 0] = along
        after[i, 1] = ca * across + sa * z
        after[i, 2] = ca * z - sa * across
        after[i, 3] = before[i, 3] + a * along + d * z


def flange_pose(model: UrModel, q: Floats) -> Floats:
    """T_base_flange, shape (..., 4, 4), mm, of configurations ``q``, shape (..., 6), rad."""
    return np.ascontiguousarray(link_poses(model, q)[..., 6, :, :])


def jacobian(model: UrModel, q: Floats) -> Floats:
    """The geometric Jacobian of the flange, base frame.

    Args:
        model: The arm.
        q: Shape (..., 6), rad.

    Returns:
        Shape (..., 6, 6): rows 0-2 give the velocity of the flange origin in mm/s, rows 3-5 the angular velocity in
        rad/s, from joint speeds in rad/s.
    """
    frames = link_poses(model, _rows(q))
    columns = np.empty((len(frames), 6, 6))
    jacobians(frames, columns)
    return columns.reshape(*np.shape(q)[:-1], 6, 6)


@allocation_free()
def jacobians(frames, J):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``J`` (n, 6, 6) from ``frames`` (n, 7, 4, 4): axis x lever above axis, one column a joint."""
    for row in range(len(frames)):
        flange = frames[row, 6]
        for joint in range(6):
            frame = frames[row, joint]
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                lever_j, lever_k = flange[j, 3] - frame[j, 3], flange[k, 3] - frame[k, 3]
                J[row, i, joint] = frame[j, 2] * lever_k - frame[k, 2] * lever_j
                J[row, 3 + i, joint] = frame[i, 2]
