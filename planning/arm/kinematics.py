"""Forward and inverse kinematics of the UR arms, in closed form, for many poses at once.

The base frame is the controller's (a URDF's ``base_link`` is rotated by 180 deg about z against it). Frames follow
Denavit and Hartenberg: T_{i-1}_{i} = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i). The inverse is the usual split of a wrist
with parallel axes 2, 3, 4 (Hawkins, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms", 2013),
with the wrist solved by ``atan2`` from the orientation alone so that it stays exact next to its singularity. The
loops are in :mod:`puncture_twin.planning.arm.kernels`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm import kernels
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, Ints

N_BRANCHES = 8
"""Shoulder left or right, times wrist flipped or not, times elbow up or down, in this order of weight 4, 2, 1."""


class Singularity(NamedTuple):
    """How far a configuration is from the three singularities of a UR arm; each 0 (singular) to 1. Shapes (...)."""

    shoulder: Floats
    """In-plane distance of the wrist centre from axis 1, over the longest possible."""
    elbow: Floats
    """|sin q3|."""
    wrist: Floats
    """|sin q5|."""

    def least(self) -> Floats:
        """The smallest of the three, shape (...)."""
        return np.minimum(np.minimum(self.shoulder, self.elbow), self.wrist)

    @property
    def nearest(self) -> str:
        """Name of the nearest one, for a single configuration."""
        return min(self._fields, key=lambda name: float(getattr(self, name)))


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
    kernels.link_frames(model.lengths, rows, poses)
    return poses.reshape(*np.shape(q)[:-1], 7, 4, 4)


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
    kernels.jacobians(frames, columns)
    return columns.reshape(*np.shape(q)[:-1], 6, 6)


def singularity(model: UrModel, q: Floats) -> Singularity:
    """Distance from the three singularities.

    The Jacobian's determinant is, up to sign and constant lengths, the product of sin q3, sin q5 and the shoulder
    term a2 cos q2 + a3 cos q23 + d5 sin q234 (tests hold this).

    Args:
        model: The arm.
        q: Shape (..., 6), rad.
    """
    rows = _rows(q)
    terms = np.empty((3, len(rows)))
    kernels.singularities(model.lengths, rows, terms)
    return Singularity(*terms.reshape(3, *np.shape(q)[:-1]))


def inverse(model: UrModel, T_base_flange: Floats) -> Floats:
    """All configurations that reach each flange pose.

    Args:
        model: The arm.
        T_base_flange: Shape (n, 4, 4) or (4, 4), mm, rigid.

    Returns:
        Shape (n, 8, 6), rad, each angle in (-pi, pi]; NaN in all six joints where a branch does not exist.
        Branch index = 4 shoulder + 2 wrist + elbow; along a continuous motion away from singularities a branch
        keeps its index. With the wrist aligned (sin q5 = 0) q6 is free and taken as 0, though another q6 might
        reach where 0 does not.
    """
    poses = np.array(T_base_flange, dtype=np.float64, order="C").reshape(-1, 4, 4)
    q = np.empty((len(poses), N_BRANCHES, 6))
    kernels.inverse_all(model.lengths, poses, q)
    return q


def branch_of(model: UrModel, q: Floats) -> Ints:
    """Which of the eight branches of `inverse` configurations (n, 6), rad, belong to, shape (n,)."""
    turns = np.abs(wrap_to_pi(inverse(model, flange_pose(model, q)) - q[:, None])).max(axis=2)
    return np.asarray(np.argmin(np.where(np.isnan(turns), np.inf, turns), axis=1))


def missing_reach_mm(model: UrModel, T_base_flange: Floats) -> Floats:
    """By how much upper arm and forearm are too short (or too long, folded) to reach each flange pose.

    Args:
        model: The arm.
        T_base_flange: Shape (n, 4, 4), mm.

    Returns:
        Shape (n,), mm: the least over all branches; 0 where a solution exists; infinite where no branch can turn its
        wrist so, because the wrist centre stands inside the cylinder of radius d4 about axis 1.
    """
    poses = np.array(T_base_flange, dtype=np.float64, order="C").reshape(-1, 4, 4)
    missing = np.empty(len(poses))
    kernels.missing_reach(model.lengths, poses, missing)
    return missing


def wrap_to_pi(angle: Floats) -> Floats:
    """The same angles in (-pi, pi], any shape, rad."""
    wrapped = np.pi - np.mod(np.pi - angle, 2.0 * np.pi)
    return np.asarray(np.where(wrapped <= -np.pi, np.pi, wrapped))


def nearest_within_limits(model: UrModel, q: Floats, q_reference: Floats) -> Floats:
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


def wrapped_solutions(model: UrModel, q: Floats) -> Floats:
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
