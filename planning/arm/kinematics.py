"""Forward kinematics of the UR arms: frames of the links, the Jacobian, and the distance from singularities.

The base frame is the controller's (a URDF's ``base_link`` is rotated by 180 deg about z against it). Frames follow
Denavit and Hartenberg: T_{i-1}_{i} = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i). Compiled loops take an arm as its lengths
(d1, a2, a3, d4, d5, d6) in mm.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb

TIE_DIGITS = 9
"""Distances from singular that agree to so many digits are equal: mirrored branches and rolls are, but for rounding."""

ELBOW = 2
"""The row of `link_poses` whose origin is the elbow: where the upper arm ends."""

ELBOW_DIGITS = 6
"""The same of its place, mm: it does not move with the roll."""


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


@nb.njit(cache=True)
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


@nb.njit(cache=True)
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


@nb.njit(cache=True)
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
    _singularities(model.lengths, rows, terms)
    return Singularity(*terms.reshape(3, *np.shape(q)[:-1]))


def farthest_from_singular(model: UrModel, q: Floats, elbow_towards: Floats) -> Floats:
    """Of configurations the one farthest from singular; of equals the one whose elbow lies farthest along a direction.

    A branch and its mirror image, and all rolls about the flange's axis, are equally far but for rounding: a choice
    among them by the last bit differs between machines.

    Args:
        model: The arm.
        q: Shape (n, 6), rad; rows may be NaN, not all of them.
        elbow_towards: Shape (3,), base frame: where there is room for the elbow.

    Returns:
        Shape (6,), rad.
    """
    least = np.round(singularity(model, q).least(), TIE_DIGITS)
    equal = q[least == np.nanmax(least)]
    elbow = link_poses(model, equal)[:, ELBOW, :3, 3] @ elbow_towards
    return np.asarray(equal[int(np.argmax(np.round(elbow, ELBOW_DIGITS)))])


@nb.njit(cache=True)
def _singularities(lengths, q, terms):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``terms`` (3, n) from ``q`` (n, 6)."""
    for row in range(len(q)):
        shoulder, elbow, wrist = singular_terms(lengths, q[row, 1], q[row, 2], q[row, 3], q[row, 4])
        terms[0, row], terms[1, row], terms[2, row] = shoulder, elbow, wrist


@nb.njit(cache=True)
def singular_terms(lengths, q2, q3, q4, q5):  # type: ignore[no-untyped-def]  # numba infers
    """Shoulder, elbow and wrist term, each 0 (singular) to 1."""
    a2, a3, d5 = lengths[1], lengths[2], lengths[4]
    in_plane = a2 * math.cos(q2) + a3 * math.cos(q2 + q3) + d5 * math.sin(q2 + q3 + q4)
    return abs(in_plane) / (abs(a2) + abs(a3) + d5), abs(math.sin(q3)), abs(math.sin(q5))
