"""Kinematics of UR arms: frames of the links, Jacobians, parameter errors, singularities, and tip speeds.

The base frame is the controller's (a URDF's ``base_link`` is rotated by 180 deg about z against it). Frames follow
Denavit and Hartenberg: T_{i-1}_{i} = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i). Compiled loops take an arm as its lengths
(d1, a2, a3, d4, d5, d6) in mm.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.ur import UR_MODELS, UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.numba_kernels import allocation_free
from puncture_twin.planning.formats.points import JointRecording


def _rows(q: Floats) -> Floats:
    """Configurations (..., 6) as a new array (n, 6): read-only arrays would be compiled for once more."""
    return np.array(q, dtype=np.float64, order="C").reshape(-1, 6)


def link_poses(model: UrModel, q: Floats) -> Floats:
    """Frames of the base and the six links; ``q`` (..., 6), rad.

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
    """The geometric Jacobian of the flange, base frame; ``q`` (..., 6), rad.

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

    28 parameters of arm and needle: one column a parameter, its axis times its lever (Mooring, Roth, Driels,
    "Fundamentals of Manipulator Calibration", 1991). With z_{i-1}, o_{i-1} axis and origin of joint i, and x_i, o_i of
    the frame behind it, at the tip p:

        a_i: (x_i; 0)   d_i: (z_{i-1}; 0)   alpha_i: (x_i x (p - o_i); x_i)   q_i: (z_{i-1} x (p - o_{i-1}); z_{i-1})
        tip offset: (R_flange; 0)   needle direction: (0; first two columns of R_flange)

    d2 is left out: axes 2 and 3 are parallel, and d3 moves the arm alike.

    Args:
        q: Shape (..., 6), rad.
        tip_mm: Flange to tip, along the flange's z.

    Returns:
        Shape (..., 6, 28), base frame: rows 0-2 the tip in mm, rows 3-5 the rotation in rad; per mm of a length or an
        offset, per rad of an angle.
    """
    frames = link_poses(model, q)
    R_flange = frames[..., 6, :3, :3]
    tip = frames[..., 6, :3, 3] + tip_mm * R_flange[..., 2]
    x, at_x = np.moveaxis(frames[..., 1:, :3, 0], -2, -1), frames[..., 1:, :3, 3]  # of the frame behind each joint
    z, at_z = np.moveaxis(frames[..., :6, :3, 2], -2, -1), frames[..., :6, :3, 3]  # of the frame before it
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
    """Denavit-Hartenberg numbers of one arm, each of shape (6,), mm and rad.

    T_{i-1}_{i} = Rz(q_i + zero_i) Tz(d_i) Tx(a_i) Rx(alpha_i). The parameters that err, and their order, are the first
    23 of `error_jacobian`. A calibration estimates such an arm, a twin draws one.
    """

    a: Floats
    d: Floats
    alpha: Floats
    zeros: Floats  # true zero minus nominal zero of each joint

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


MIN_SINGULARITY = 0.05
"""Each term of :class:`Singularity` must exceed this over the whole insertion. For the wrist
that is 2.9 deg; joint speeds there are up to 20 times those of the best pose, and worse below."""
TIE_DIGITS = 9
"""Distances from singular that agree to so many digits are equal: mirrored branches and rolls are, but for rounding."""
ELBOW = 2
"""The row of `link_poses` whose origin is the elbow: where the upper arm ends."""
ELBOW_DIGITS = 6
"""Decimals of the elbow's place, mm: it does not move with the roll."""


class Singularity(NamedTuple):
    """Distance of a configuration from the three singularities of a UR arm; each 0 (singular) to 1. Shapes (...)."""

    shoulder: Floats  # in-plane distance of the wrist centre from axis 1, over the longest possible
    elbow: Floats  # |sin q3|
    wrist: Floats  # |sin q5|

    def least(self) -> Floats:
        """The smallest of the three, shape (...)."""
        return np.minimum(np.minimum(self.shoulder, self.elbow), self.wrist)

    @property
    def nearest(self) -> str:
        """Name of the nearest one, for a single configuration."""
        return min(self._fields, key=lambda name: float(getattr(self, name)))


def singularity(model: UrModel, q: Floats) -> Singularity:
    """Distance of configurations (..., 6), rad, from the three singularities.

    The Jacobian's determinant is, up to sign and constant lengths, the product of sin q3, sin q5 and the shoulder
    term a2 cos q2 + a3 cos q23 + d5 sin q234 (tests hold this).
    """
    rows = _rows(q)
    terms = np.empty((3, len(rows)))
    _singularities(model.lengths, rows, terms)
    return Singularity(*terms.reshape(3, *np.shape(q)[:-1]))


def away_from_singularities(model: UrModel, q: Floats) -> NDArray[np.bool_]:
    """Whether configurations (..., 6) keep their distance from every singularity; NaN does not. Shape (...)."""
    return np.asarray(singularity(model, q).least() > MIN_SINGULARITY)


def farthest_from_singular(model: UrModel, q: Floats, elbow_towards: Floats) -> Floats:
    """The configuration farthest from singular; of equals the one whose elbow lies farthest along a direction.

    A branch and its mirror image, and all rolls about the flange's axis, are equally far but for rounding: a choice
    among them by the last bit differs between machines.

    Args:
        q: Shape (n, 6), rad; rows may be NaN, not all of them.
        elbow_towards: Shape (3,), base frame: where there is space for the elbow.

    Returns:
        Shape (6,), rad.
    """
    least = np.round(singularity(model, q).least(), TIE_DIGITS)
    equal = q[least == np.nanmax(least)]
    elbow = link_poses(model, equal)[:, ELBOW, :3, 3] @ elbow_towards
    return np.asarray(equal[int(np.argmax(np.round(elbow, ELBOW_DIGITS)))])


@allocation_free()
def _singularities(lengths, q, terms):  # type: ignore[no-untyped-def]  # numba infers
    for row in range(len(q)):
        shoulder, elbow, wrist = _singular_terms(lengths, q[row, 1], q[row, 2], q[row, 3], q[row, 4])
        terms[0, row], terms[1, row], terms[2, row] = shoulder, elbow, wrist


@allocation_free()
def _singular_terms(lengths, q2, q3, q4, q5):  # type: ignore[no-untyped-def]  # numba infers
    """Shoulder, elbow and wrist term, each 0 (singular) to 1."""
    a2, a3, d5 = lengths[1], lengths[2], lengths[4]
    in_plane = a2 * math.cos(q2) + a3 * math.cos(q2 + q3) + d5 * math.sin(q2 + q3 + q4)
    return abs(in_plane) / (abs(a2) + abs(a3) + d5), abs(math.sin(q3)), abs(math.sin(q5))


@allocation_free()
def least_term(lengths, q):  # type: ignore[no-untyped-def]  # numba infers
    """The least singularity term of one configuration (6,); NaN where that is not finite."""
    shoulder, elbow, wrist = _singular_terms(lengths, q[1], q[2], q[3], q[4])
    return min(shoulder, elbow, wrist) if not math.isnan(shoulder) else math.nan


class SpeedLimits(NamedTuple):
    """Speed limits that a case allows, and its plan keeps. The names are the keys of ``[robot]``."""

    tip_speed_mm_s: float = 250.0
    """Speed of the needle's tip on the approach: what ISO 10218-1 calls reduced speed."""

    insertion_speed_mm_s: float = 10.0
    """Speed of the tip along the insertion: a needle is inserted slowly, and an operator must be able to stop it."""

    joint_speed_fraction: float = 0.5
    """Fraction of each joint's highest speed, as MoveIt's velocity scaling."""

    joint_acceleration_fraction: float = 1.0
    """Fraction of each joint's highest acceleration, as MoveIt's acceleration scaling."""


DEFAULT_SPEEDS = SpeedLimits()
"""Speeds where none are stated."""
HIGHEST = SpeedLimits(1000.0, 100.0, 1.0, 1.0)
"""The highest speeds that a case may state: a UR's usual tool speed, a needle that is pushed briskly, and all that the
joints can."""


def slowed(model: UrModel, speeds: SpeedLimits) -> UrModel:
    """The arm with its joints' speed and acceleration limits cut down to the fractions."""
    return replace(
        model,
        max_speeds=speeds.joint_speed_fraction * model.max_speeds,
        max_acceleration=speeds.joint_acceleration_fraction * model.max_acceleration,
    )


class TipLimit(NamedTuple):
    """The highest speed of a point on the flange's z axis."""

    tip_mm: float  # flange to tip

    speed_mm_s: float


def tip_rates(model: UrModel, q: Floats, directions: Floats, tip_mm: float) -> Floats:
    """How fast the tip moves while the joints move at given speeds: |J_v u + (J_w u) x l z|, shape (m,), mm/s.

    At joints ``q`` (m, 6), rad. u is ``directions``, (m, 6) or (6,), rad/s, or per whatever else the tip's speed is
    then per; l is ``tip_mm``, from flange to tip along the flange's z.
    """
    twists = np.einsum("mij,mj->mi", jacobian(model, q), np.broadcast_to(directions, q.shape))
    lever = tip_mm * flange_pose(model, q)[:, :3, 2]
    return np.asarray(np.linalg.norm(twists[:, :3] + np.cross(twists[:, 3:], lever), axis=1))


def tip_speeds(model: UrModel, q: Floats, times_s: Floats, tip_mm: float) -> Floats:
    """The tip's mean speed between the samples of a motion ``q`` (m, 6), rad, at rising times (m,): (m - 1,), mm/s.

    ``tip_mm`` is from flange to tip, along the flange's z.
    """
    poses = flange_pose(model, q)
    tips = poses[:, :3, 3] + tip_mm * poses[:, :3, 2]
    return np.asarray(np.linalg.norm(np.diff(tips, axis=0), axis=1) / np.diff(times_s))


MOST_OFF_MM = 5.0
"""A controller with its own calibration puts the tip up to some mm from where the data sheet's arm does."""
FITS_MM = 1.5
"""Another model whose joints put the tool so near to where it was is the arm that was recorded."""
LEVER_MM = 95.0
"""A flange's axes are compared with joints by points so far out: 3 degrees move them by 5 mm."""


def check_arm(
    model: UrModel,
    q: Floats,
    points_base: Floats,
    tools_flange: Sequence[Floats],
    *,
    names: Sequence[str],
    where: str | Path,
    any_tool: bool = False,
) -> None:
    """Refuse joints that do not put the tool at the place that their own file states: they are of another arm.

    A UR3e's joints read as a UR3's are 18 mm off, and six angles alone do not show it. Where a recording states a point
    besides them, both must agree with the arm's nominal lengths, up to what a controller's own calibration moves.

    Args:
        q: Shape (n, 6), rad.
        points_base: Shape (n, 3), mm: where the tool was.
        tools_flange: What the tool may be: points (3,) of the flange, mm.
        any_tool: Whether it may also be any other point, the same in all rows.

    Raises:
        InputError: Names the row that is farthest off, and the models that would fit.
    """

    def off(one: UrModel, known: bool) -> Floats:
        flanges = flange_pose(one, q)
        R, gaps = flanges[:, :3, :3], points_base - flanges[:, :3, 3]
        tools = [*tools_flange] if known else [np.median(np.einsum("nji,nj->ni", R, gaps), axis=0)]
        return min((np.linalg.norm(R @ tool - gaps, axis=1) for tool in tools), key=lambda misses: float(misses.max()))

    for known in (True, False) if any_tool else (True,):
        own = off(model, known)
        if own.max() <= MOST_OFF_MM:
            return
        likely = [one.name for one in UR_MODELS.values() if one != model and off(one, known).max() <= FITS_MM]
        if likely:
            break
    row = int(np.argmax(own))
    arm = f"; those of a {' or '.join(likely)} do not" if likely else ""
    what = f"the joints of {names[row]} put the tool of a {model.name} {own[row]:.1f} mm from where it was{arm}"
    allowed = f"within {MOST_OFF_MM:g} mm: joints of the case's arm, in their unit, with its needle"
    refuse(what, where, allowed, "joints_of_another_arm")


def check_recording(model: UrModel, tip_mm: float, recording: JointRecording, *, where: str | Path) -> None:
    """Refuse a recording whose controller had its tool where this arm's joints do not put one; without a tool, nothing.

    The tool may be the flange, the tip, or another point that all rows share.
    """
    if recording.tool_base is None:
        return
    tools = [np.zeros(3), np.array([0.0, 0.0, tip_mm])]
    names = [f"row {number}" for number in range(1, len(recording.q) + 1)]
    check_arm(model, recording.q, recording.tool_base, tools, names=names, where=where, any_tool=True)


def check_flanges(model: UrModel, q: Floats, T_base_flange: Floats, *, names: Sequence[str], where: str | Path) -> None:
    """Refuse joints (n, 6), rad, that do not belong to flanges (n, 4, 4), mm, in place and axes."""
    for tool in (np.zeros(3), *(LEVER_MM * np.eye(3)[:2])):
        points = T_base_flange[:, :3, 3] + T_base_flange[:, :3, :3] @ tool
        check_arm(model, q, points, [tool], names=names, where=where)
