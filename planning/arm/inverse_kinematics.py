"""Inverse kinematics of the UR arms, in closed form: every branch, for many flange poses at once.

The usual split of a wrist with parallel axes 2, 3, 4 (Hawkins, "Analytic inverse kinematics for the Universal Robots
UR-5/UR-10 arms", 2013), with the wrist solved by ``atan2`` from the orientation alone so that it stays exact next to
its singularity. Frames and lengths are those of :mod:`puncture_twin.planning.arm.kinematics`.
"""

import math

import numpy as np

from puncture_twin.planning.arm.kinematics import MIN_SINGULARITY, flange_pose, singularity
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.numba_kernels import allocation_free, nb

N_BRANCHES = 8
"""Shoulder left or right, times wrist flipped or not, times elbow up or down, in this order of weight 4, 2, 1."""
EVERY_BRANCH = (1 << N_BRANCHES) - 1
"""A bit for each of them."""
BOUNDARY_TOLERANCE = 1e-12
"""How far a cosine may exceed 1 and still count as the stretched pose: rounding of its few products, which moves
the flange by less than 1e-9 mm."""
WRIST_FREE = 1e-12
"""Below this |sin q5| axes 4 and 6 are one within rounding: q6 is free, and 0 is taken."""
TURN = 2.0 * math.pi


def inverse(model: UrModel, T_base_flange: Floats) -> Floats:
    """All joint configurations that put the flange at each pose; ``T_base_flange`` (n, 4, 4) or (4, 4), mm, rigid.

    Returns:
        Shape (n, 8, 6), rad, each angle in (-pi, pi]; NaN in all six joints where a branch does not exist.
        Branch index = 4 shoulder + 2 wrist + elbow; along a continuous motion away from singularities a branch
        keeps its index. With the wrist aligned (sin q5 = 0) q6 is free and taken as 0, though another q6 might
        reach where 0 does not.
    """
    poses = np.array(T_base_flange, dtype=np.float64, order="C").reshape(-1, 4, 4)
    q = np.empty((len(poses), N_BRANCHES, 6))
    _inverse_all(model.lengths, poses, q)
    return q


@nb.njit(cache=True)
def _inverse_all(lengths, T, q):  # type: ignore[no-untyped-def]  # numba infers
    R, p = np.empty((3, 3)), np.empty(3)
    for row in range(len(T)):
        for i in range(3):
            for j in range(3):
                R[i, j] = T[row, i, j]
            p[i] = T[row, i, 3]
        fill_branches(lengths, R, p, q[row], np.int64(EVERY_BRANCH))


@allocation_free()
def fill_branches(lengths, R, p, q, wanted):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``q`` (8, 6) for the flange at ``R`` (3, 3) and ``p`` (3,).

    ``wanted`` has bit b set where branch b is wanted; of the others some may be filled, and some be NaN.
    """
    a2, a3, d6 = lengths[1], lengths[2], lengths[5]
    q[:] = math.nan
    for side in range(2):
        if not wanted >> 4 * side & 15:
            continue
        q1 = pan_angle(lengths, p[0] - d6 * R[0, 2], p[1] - d6 * R[1, 2], 1.0 - 2.0 * side)
        if math.isnan(q1):
            continue
        c1, s1 = math.cos(q1), math.sin(q1)
        for flip in range(2):
            if not wanted >> (4 * side + 2 * flip) & 3:
                continue
            q5, q6, q234, x, y = wrist_angles(lengths, R, p, c1, s1, 1.0 - 2.0 * flip)
            cosine = _bend(lengths, x, y)
            if math.isnan(cosine):
                continue
            q3 = math.acos(cosine)
            bearing = math.atan2(y, x)
            lead = math.atan2(a3 * math.sin(q3), a2 + a3 * cosine)
            for elbow in range(2):
                up = 1.0 - 2.0 * elbow
                row = 4 * side + 2 * flip + elbow
                q2 = bearing - up * lead
                q[row, 0] = wrapped_angle(q1)
                q[row, 1] = wrapped_angle(q2)
                q[row, 2] = wrapped_angle(up * q3)
                q[row, 3] = wrapped_angle(q234 - q2 - up * q3)
                q[row, 4] = wrapped_angle(q5)
                q[row, 5] = wrapped_angle(q6)


@allocation_free()
def pan_angle(lengths, px, py, side):  # type: ignore[no-untyped-def]  # numba infers
    """q1 for the wrist centre's (x, y): the arm's plane passes it at the distance d4. NaN inside that circle."""
    d4 = lengths[3]
    radius = math.sqrt(px * px + py * py)
    if radius >= d4:
        in_plane = math.sqrt((radius - d4) * (radius + d4))
    elif radius > d4 * (1.0 - BOUNDARY_TOLERANCE):
        in_plane = 0.0
    else:
        return math.nan
    return math.atan2(py, px) + math.atan2(d4, side * in_plane)


@allocation_free()
def wrist_angles(lengths, R, p, c1, s1, flip):  # type: ignore[no-untyped-def]  # numba infers
    """q5, q6, q234, and where they leave wrist 1: in the arm's plane and up, seen from the shoulder."""
    # The three parallel axes point along (s1, -c1, 0); their parts along the flange's axes give the wrist.
    along_x, along_y = s1 * R[0, 0] - c1 * R[1, 0], s1 * R[0, 1] - c1 * R[1, 1]
    along_z = s1 * R[0, 2] - c1 * R[1, 2]
    size = math.sqrt(along_x * along_x + along_y * along_y)
    q5 = math.atan2(flip * size, along_z)
    c6, s6, q6 = 1.0, 0.0, 0.0
    if size >= WRIST_FREE:
        c6, s6 = flip * along_x / size, -flip * along_y / size
        q6 = math.atan2(s6, c6)
    zx = -(s6 * R[0, 0] + c6 * R[0, 1])  # axis 5
    zy = -(s6 * R[1, 0] + c6 * R[1, 1])
    zz = -(s6 * R[2, 0] + c6 * R[2, 1])
    d1, d5, d6 = lengths[0], lengths[4], lengths[5]
    x, y = p[0] - d6 * R[0, 2] - d5 * zx, p[1] - d6 * R[1, 2] - d5 * zy
    q234 = math.atan2(c1 * zx + s1 * zy, -zz)
    return q5, q6, q234, c1 * x + s1 * y, p[2] - d6 * R[2, 2] - d5 * zz - d1


@allocation_free()
def _bend(lengths, x, y):  # type: ignore[no-untyped-def]  # numba infers
    """Cosine of the elbow that reaches (x, y) in the shoulder's plane; NaN where that is too far or too near."""
    a2, a3 = lengths[1], lengths[2]
    cosine = (x * x + y * y - a2 * a2 - a3 * a3) / (2.0 * a2 * a3)
    if abs(cosine) <= 1.0:
        return cosine
    return math.copysign(1.0, cosine) if abs(cosine) < 1.0 + BOUNDARY_TOLERANCE else math.nan


@allocation_free(inline="always")
def wrapped_angle(angle):  # type: ignore[no-untyped-def]  # numba infers
    """An angle wrapped to (-pi, pi]; untouched where it is there already."""
    if -math.pi < angle <= math.pi:
        return angle
    angle = math.pi - (math.pi - angle) % TURN
    return math.pi if angle <= -math.pi else angle


def branch_of(model: UrModel, q: Floats) -> Ints:
    """Which of the eight branches of `inverse` configurations (n, 6), rad, belong to, shape (n,)."""
    turns = np.abs(wrap_to_pi(inverse(model, flange_pose(model, q)) - q[:, None])).max(axis=2)
    return np.asarray(np.argmin(np.where(np.isnan(turns), np.inf, turns), axis=1))


def wrap_to_pi(angle: Floats) -> Floats:
    """Angles wrapped to (-pi, pi], any shape, rad."""
    wrapped = np.pi - np.mod(np.pi - angle, 2.0 * np.pi)
    return np.asarray(np.where(wrapped <= -np.pi, np.pi, wrapped))


def nearest_within_limits(model: UrModel, q: Floats, q_reference: Floats) -> Floats:
    """The whole turns added to each joint that bring it nearest to a reference without leaving its limits.

    Of joints (..., 6), rad, to a reference that broadcasts against them; so is the result. NaN in all six where some
    joint has no such turn.
    """
    low, high = model.joint_limits[:, 0], model.joint_limits[:, 1]
    fewest, most = np.ceil((low - q) / TURN), np.floor((high - q) / TURN)
    turns = np.clip(np.round((q_reference - q) / TURN), fewest, most)
    wrapped = np.where(fewest <= most, np.clip(q + TURN * turns, low, high), np.nan)  # the sum may round beyond
    wrapped[np.isnan(wrapped).any(axis=-1)] = np.nan
    return wrapped


def wrapped_solutions(model: UrModel, q: Floats) -> Floats:
    """Every configuration within the limits that differs from one by whole turns; ``q`` (6,), rad, finite.

    Shape (n, 6), rad; empty when some joint has none.
    """
    choices = []
    for angle, (low, high) in zip(q, model.joint_limits, strict=True):
        turns = np.arange(math.ceil((low - angle) / TURN), math.floor((high - angle) / TURN) + 1)
        choices.append(np.clip(angle + TURN * turns, low, high))  # the sum may round beyond
    return np.stack(np.meshgrid(*choices, indexing="ij"), axis=-1).reshape(-1, 6)


def why_unreachable(model: UrModel, T_base_flange: Floats) -> str:
    """Why no branch of the arm reaches one flange pose (4, 4), mm: one sentence for people."""
    place = f"the flange would be {np.linalg.norm(T_base_flange[:3, 3] - model.shoulder_base):.1f} mm from the shoulder"
    missing = float(missing_reach_mm(model, T_base_flange)[0])
    if math.isinf(missing):
        return f"{place}, its wrist too close to the base axis for any shoulder angle"
    if missing > 0.0:
        return f"{place}, {missing:.1f} mm out of the arm's reach in this direction"
    solutions = inverse(model, T_base_flange)[0]
    best = singularity(model, solutions[np.nanargmax(singularity(model, solutions).least())])
    return f"{place}, too near the {best.nearest} singularity ({best.least():.3f}, at least {MIN_SINGULARITY})"


def missing_reach_mm(model: UrModel, T_base_flange: Floats) -> Floats:
    """Length by which upper arm and forearm are too short (or too long, folded) for flange poses (n, 4, 4): (n,), mm.

    The least over all branches; 0 where a solution exists; infinite where no branch can turn its wrist so, because the
    wrist centre stands inside the cylinder of radius d4 about axis 1.
    """
    poses = np.array(T_base_flange, dtype=np.float64, order="C").reshape(-1, 4, 4)
    missing = np.empty(len(poses))
    _missing_reach(model.lengths, poses, missing)
    return missing


@allocation_free()
def _missing_reach(lengths, T, missing):  # type: ignore[no-untyped-def]  # numba infers
    upper, fore, d6 = abs(lengths[1]), abs(lengths[2]), lengths[5]
    for row in range(len(T)):
        R, p = T[row, :3, :3], T[row, :3, 3]
        missing[row] = math.inf
        for side in (1.0, -1.0):
            q1 = pan_angle(lengths, p[0] - d6 * R[0, 2], p[1] - d6 * R[1, 2], side)
            if math.isnan(q1):
                continue
            for flip in (1.0, -1.0):
                _, _, _, x, y = wrist_angles(lengths, R, p, math.cos(q1), math.sin(q1), flip)
                far = math.sqrt(x * x + y * y)
                missing[row] = min(missing[row], max(far - (upper + fore), abs(upper - fore) - far, 0.0))
