"""Forward and inverse kinematics of the UR arms, in closed form, for many poses at once.

The base frame is the controller's (a URDF's ``base_link`` is turned by 180 deg about z against it). Frames follow
Denavit and Hartenberg: T_{i-1}_{i} = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i). The inverse is the usual split of a wrist
with parallel axes 2, 3, 4 (Hawkins, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms", 2013),
with the wrist solved by ``atan2`` from the orientation alone so that it stays exact next to its singularity.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.robot.ur import UrModel

Array = NDArray[np.float64]

N_BRANCHES = 8
"""Shoulder left or right, times wrist flipped or not, times elbow up or down, in this order of weight 4, 2, 1."""

BOUNDARY_TOLERANCE = 1e-12
"""How far a cosine may exceed 1 and still count as the stretched pose: rounding of its few products, which moves
the flange by less than 1e-9 mm."""

WRIST_FREE = 1e-12
"""Below this |sin q5| axes 4 and 6 are one within rounding: q6 is free, and 0 is taken."""


class Singularity(NamedTuple):
    """How far a configuration is from the three singularities of a UR arm; each 0 (singular) to 1. Shapes (...)."""

    shoulder: Array
    """In-plane distance of the wrist centre from axis 1, over the longest possible."""
    elbow: Array
    """|sin q3|."""
    wrist: Array
    """|sin q5|."""

    def least(self) -> Array:
        """The smallest of the three, shape (...)."""
        return np.minimum(np.minimum(self.shoulder, self.elbow), self.wrist)


def link_poses(model: UrModel, q: Array) -> Array:
    """Frames of the base and the six links.

    Args:
        model: The arm.
        q: Shape (..., 6), rad.

    Returns:
        T_base_link, shape (..., 7, 4, 4), mm: the base (identity) first, the flange last.
    """
    q = np.asarray(q, dtype=np.float64)
    poses = np.zeros((*q.shape[:-1], 7, 4, 4))
    poses[..., 0, :, :] = np.eye(4)
    for joint in range(6):
        step = _dh(q[..., joint], model.a[joint], model.d[joint], model.alpha[joint])
        poses[..., joint + 1, :, :] = poses[..., joint, :, :] @ step
    return poses


def flange_pose(model: UrModel, q: Array) -> Array:
    """T_base_flange, shape (..., 4, 4), mm, of configurations ``q``, shape (..., 6), rad."""
    return np.ascontiguousarray(link_poses(model, q)[..., 6, :, :])


def _dh(q: Array, a: float, d: float, alpha: float) -> Array:
    c, s = np.cos(q), np.sin(q)
    ca, sa = round(math.cos(alpha)), round(math.sin(alpha))  # all twists are quarter turns
    T = np.zeros((*q.shape, 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2], T[..., 0, 3] = c, -s * ca, s * sa, a * c
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2], T[..., 1, 3] = s, c * ca, -c * sa, a * s
    T[..., 2, 1], T[..., 2, 2], T[..., 2, 3] = sa, ca, d
    T[..., 3, 3] = 1.0
    return T


def jacobian(model: UrModel, q: Array) -> Array:
    """The geometric Jacobian of the flange, base frame.

    Args:
        model: The arm.
        q: Shape (..., 6), rad.

    Returns:
        Shape (..., 6, 6): rows 0-2 give the velocity of the flange origin in mm/s, rows 3-5 the angular velocity in
        rad/s, from joint speeds in rad/s.
    """
    poses = link_poses(model, q)
    axes = poses[..., :6, :3, 2]
    levers = poses[..., 6:7, :3, 3] - poses[..., :6, :3, 3]
    columns = np.concatenate([np.cross(axes, levers), axes], axis=-1)
    return np.ascontiguousarray(np.swapaxes(columns, -1, -2))


def singularity(model: UrModel, q: Array) -> Singularity:
    """Distance from the three singularities.

    The Jacobian's determinant is, up to sign and constant lengths, the product of sin q3, sin q5 and the shoulder
    term a2 cos q2 + a3 cos q23 + d5 sin q234 (tests hold this).

    Args:
        model: The arm.
        q: Shape (..., 6), rad.
    """
    q23 = q[..., 1] + q[..., 2]
    in_plane = model.a2 * np.cos(q[..., 1]) + model.a3 * np.cos(q23) + model.d5 * np.sin(q23 + q[..., 3])
    longest = abs(model.a2) + abs(model.a3) + model.d5
    return Singularity(np.abs(in_plane) / longest, np.abs(np.sin(q[..., 2])), np.abs(np.sin(q[..., 4])))


def inverse(model: UrModel, T_base_flange: Array) -> Array:
    """All configurations that hold each flange pose.

    Args:
        model: The arm.
        T_base_flange: Shape (n, 4, 4) or (4, 4), mm, rigid.

    Returns:
        Shape (n, 8, 6), rad, each angle in (-pi, pi]; NaN in all six joints where a branch does not exist.
        Branch index = 4 shoulder + 2 wrist + elbow; along a continuous motion away from singularities a branch
        keeps its index. With the wrist aligned (sin q5 = 0) q6 is free and taken as 0, though another q6 might
        reach where 0 does not.
    """
    wrist = _solve_wrist(model, np.asarray(T_base_flange, dtype=np.float64).reshape(-1, 4, 4))
    q2, q3 = _two_links(model, wrist.in_plane, wrist.up)  # (n, 2, 2, 2)
    q4 = wrist.q234[..., None] - q2 - q3
    q1 = wrist.q1[..., None, None]
    q = np.stack(np.broadcast_arrays(q1, q2, q3, q4, wrist.q5[..., None], wrist.q6[..., None]), axis=-1)
    q = wrap_to_pi(q.reshape(-1, N_BRANCHES, 6))
    q[np.isnan(q).any(axis=-1)] = np.nan
    return q


def missing_reach_mm(model: UrModel, T_base_flange: Array) -> Array:
    """By how much upper arm and forearm are too short (or too long, folded) to hold each flange pose.

    Args:
        model: The arm.
        T_base_flange: Shape (n, 4, 4), mm.

    Returns:
        Shape (n,), mm: the least over all branches; 0 where a solution exists; infinite where no branch can turn its
        wrist so, because the wrist centre stands inside the cylinder of radius d4 about axis 1.
    """
    wrist = _solve_wrist(model, np.asarray(T_base_flange, dtype=np.float64).reshape(-1, 4, 4))
    distance = np.hypot(wrist.in_plane, wrist.up).reshape(-1, 4)
    upper, fore = abs(model.a2), abs(model.a3)
    missing = np.maximum(np.maximum(distance - (upper + fore), abs(upper - fore) - distance), 0.0)
    return np.asarray(np.nan_to_num(missing, nan=np.inf).min(axis=1))


class _Wrist(NamedTuple):
    """The wrist's joints, and where they leave wrist 1 in the plane of the arm. All but q1 of shape (n, 2, 2)."""

    q1: Array
    q5: Array
    q6: Array
    q234: Array
    in_plane: Array
    up: Array


def _solve_wrist(model: UrModel, T: Array) -> _Wrist:
    """Shoulder pan (n, 2), then the wrist for each, flipped or not (n, 2, 2). NaN where there is no shoulder pan."""
    x6, y6, z6 = T[:, :3, 0, None], T[:, :3, 1, None], T[:, :3, 2, None]
    p6 = T[:, :3, 3, None]
    q1 = _shoulder_pan(model, (p6 - model.d6 * z6)[:, :2, 0])
    s1, c1 = np.sin(q1), np.cos(q1)
    # The three parallel axes point along z1 = (s1, -c1, 0); its parts along the flange's axes give the wrist.
    along_x, along_y, along_z = (s1 * axis[:, 0] - c1 * axis[:, 1] for axis in (x6, y6, z6))
    flip = np.array([1.0, -1.0])
    sin5 = np.hypot(along_x, along_y)[..., None] * flip
    q5 = np.arctan2(sin5, along_z[..., None])
    q6 = np.arctan2(-along_y[..., None] * flip, along_x[..., None] * flip)
    q6 = np.where(np.abs(sin5) < WRIST_FREE, 0.0, q6)
    s6, c6 = np.sin(q6), np.cos(q6)
    x6, y6, z6, p6 = (v[:, :, :, None] for v in (x6, y6, z6, p6))  # (n, 3, 1, 1)
    z4 = -(s6[:, None] * x6 + c6[:, None] * y6)  # axis 5, (n, 3, 2, 2)
    p4 = p6 - model.d6 * z6 - model.d5 * z4
    s1, c1 = s1[..., None], c1[..., None]
    q234 = np.arctan2(c1 * z4[:, 0] + s1 * z4[:, 1], -z4[:, 2])
    return _Wrist(q1, q5, q6, q234, c1 * p4[:, 0] + s1 * p4[:, 1], p4[:, 2] - model.d1)


def _shoulder_pan(model: UrModel, wrist_xy: Array) -> Array:
    """q1, shape (n, 2): the arm's plane passes the wrist centre (n, 2) at the distance d4. NaN inside that circle."""
    radius = np.hypot(wrist_xy[:, 0], wrist_xy[:, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        in_plane = np.sqrt((radius - model.d4) * (radius + model.d4))
    barely = (radius < model.d4) & (radius > model.d4 * (1.0 - BOUNDARY_TOLERANCE))
    in_plane = np.where(barely, 0.0, in_plane)
    bearing = np.arctan2(wrist_xy[:, 1], wrist_xy[:, 0])[:, None]
    return np.asarray(bearing + np.arctan2(model.d4, in_plane[:, None] * np.array([1.0, -1.0])))


def _two_links(model: UrModel, x: Array, y: Array) -> tuple[Array, Array]:
    """q2 and q3, each (..., 2), that reach (x, y) in the shoulder's plane. NaN where that is too far or too near."""
    a2, a3 = model.a2, model.a3
    cosine = (x * x + y * y - a2 * a2 - a3 * a3) / (2.0 * a2 * a3)
    barely = (np.abs(cosine) > 1.0) & (np.abs(cosine) < 1.0 + BOUNDARY_TOLERANCE)
    cosine = np.where(barely, np.sign(cosine), cosine)
    with np.errstate(invalid="ignore"):
        bend = np.arccos(cosine)[..., None] * np.array([1.0, -1.0])
    q2 = np.arctan2(y, x)[..., None] - np.arctan2(a3 * np.sin(bend), a2 + a3 * np.cos(bend))
    return q2, bend


def wrap_to_pi(angle: Array) -> Array:
    """The same angles in (-pi, pi], any shape, rad."""
    wrapped = np.pi - np.mod(np.pi - angle, 2.0 * np.pi)
    return np.asarray(np.where(wrapped <= -np.pi, np.pi, wrapped))


def nearest_within_limits(model: UrModel, q: Array, q_reference: Array) -> Array:
    """The whole turns added to each joint that bring it nearest to a reference without leaving its limits.

    Args:
        model: The arm.
        q: Shape (..., 6), rad.
        q_reference: Broadcasts against ``q``, rad.

    Returns:
        Shape (..., 6), rad; NaN in all six joints where some joint has no such turn.
    """
    turn = 2.0 * np.pi
    low, high = model.joint_limits[:, 0], model.joint_limits[:, 1]
    fewest, most = np.ceil((low - q) / turn), np.floor((high - q) / turn)
    turns = np.clip(np.round((q_reference - q) / turn), fewest, most)
    wrapped = np.where(fewest <= most, np.clip(q + turn * turns, low, high), np.nan)  # the sum may round beyond
    wrapped[np.isnan(wrapped).any(axis=-1)] = np.nan
    return wrapped


def wrapped_solutions(model: UrModel, q: Array) -> Array:
    """Every configuration within the limits that differs from one by whole turns.

    Args:
        model: The arm.
        q: Shape (6,), rad, finite.

    Returns:
        Shape (n, 6), rad; empty when some joint has none.
    """
    turn = 2.0 * np.pi
    choices = []
    for angle, (low, high) in zip(q, model.joint_limits, strict=True):
        turns = np.arange(math.ceil((low - angle) / turn), math.floor((high - angle) / turn) + 1)
        choices.append(np.clip(angle + turn * turns, low, high))  # the sum may round beyond
    return np.stack(np.meshgrid(*choices, indexing="ij"), axis=-1).reshape(-1, 6)
