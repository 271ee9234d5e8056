"""Compiled kinematics of the UR arms: poses, all inverse branches, and the path of a branch along a needle.

Plain loops over plain arrays, called by :mod:`planning.arm.kinematics` and :mod:`planning.arm.insertion`, which
say what they compute and where it comes from. An arm is its lengths (d1, a2, a3, d4, d5, d6) in mm.
"""

# mypy: disable-error-code="no-untyped-def"
# numba infers the types

from __future__ import annotations

import math

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb

BOUNDARY_TOLERANCE = 1e-12
"""How far a cosine may exceed 1 and still count as the stretched pose: rounding of its few products, which moves
the flange by less than 1e-9 mm."""

WRIST_FREE = 1e-12
"""Below this |sin q5| axes 4 and 6 are one within rounding: q6 is free, and 0 is taken."""

TURN = 2.0 * math.pi


@nb.njit(cache=True, inline="always")
def _wrapped(angle):
    """The same angle in (-pi, pi]; untouched where it is there already."""
    if -math.pi < angle <= math.pi:
        return angle
    angle = math.pi - (math.pi - angle) % TURN
    return math.pi if angle <= -math.pi else angle


@nb.njit(cache=True)
def _next_frame(before, after, c, s, a, d, ca, sa):
    """``after`` = ``before`` Rz Tz(d) Tx(a) Rx, with cosine and sine of the joint and of the twist."""
    for i in range(3):
        x, y, z = before[i, 0], before[i, 1], before[i, 2]
        along = c * x + s * y
        across = c * y - s * x
        after[i, 0] = along
        after[i, 1] = ca * across + sa * z
        after[i, 2] = ca * z - sa * across
        after[i, 3] = before[i, 3] + a * along + d * z


@nb.njit(cache=True)
def link_frames(lengths, q, frames):
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
def jacobians(frames, J):
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


@nb.njit(cache=True)
def _singular_terms(lengths, q2, q3, q4, q5):
    """Shoulder, elbow and wrist term, each 0 (singular) to 1."""
    a2, a3, d5 = lengths[1], lengths[2], lengths[4]
    in_plane = a2 * math.cos(q2) + a3 * math.cos(q2 + q3) + d5 * math.sin(q2 + q3 + q4)
    return abs(in_plane) / (abs(a2) + abs(a3) + d5), abs(math.sin(q3)), abs(math.sin(q5))


@nb.njit(cache=True)
def singularities(lengths, q, terms):
    """Fill ``terms`` (3, n) from ``q`` (n, 6)."""
    for row in range(len(q)):
        shoulder, elbow, wrist = _singular_terms(lengths, q[row, 1], q[row, 2], q[row, 3], q[row, 4])
        terms[0, row], terms[1, row], terms[2, row] = shoulder, elbow, wrist


@nb.njit(cache=True)
def _pan(lengths, px, py, side):
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


@nb.njit(cache=True)
def _wrist(lengths, R, p, c1, s1, flip):
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


@nb.njit(cache=True)
def _bend(lengths, x, y):
    """Cosine of the elbow that reaches (x, y) in the shoulder's plane. NaN where that is too far or too near."""
    a2, a3 = lengths[1], lengths[2]
    cosine = (x * x + y * y - a2 * a2 - a3 * a3) / (2.0 * a2 * a3)
    if abs(cosine) <= 1.0:
        return cosine
    return math.copysign(1.0, cosine) if abs(cosine) < 1.0 + BOUNDARY_TOLERANCE else math.nan


@nb.njit(cache=True)
def _branches(lengths, R, p, q, only):
    """Fill ``q`` (8, 6) for the flange at ``R`` (3, 3) and ``p`` (3,); one row alone unless ``only`` < 0."""
    a2, a3, d6 = lengths[1], lengths[2], lengths[5]
    q[:] = math.nan
    for side in range(2):
        if only >= 0 and only // 4 != side:
            continue
        q1 = _pan(lengths, p[0] - d6 * R[0, 2], p[1] - d6 * R[1, 2], 1.0 - 2.0 * side)
        if math.isnan(q1):
            continue
        c1, s1 = math.cos(q1), math.sin(q1)
        for flip in range(2):
            if only >= 0 and only // 2 % 2 != flip:
                continue
            q5, q6, q234, x, y = _wrist(lengths, R, p, c1, s1, 1.0 - 2.0 * flip)
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
                q[row, 0] = _wrapped(q1)
                q[row, 1] = _wrapped(q2)
                q[row, 2] = _wrapped(up * q3)
                q[row, 3] = _wrapped(q234 - q2 - up * q3)
                q[row, 4] = _wrapped(q5)
                q[row, 5] = _wrapped(q6)


@nb.njit(cache=True)
def inverse_all(lengths, T, q):
    """Fill ``q`` (n, 8, 6) from flange poses ``T`` (n, 4, 4)."""
    for row in range(len(T)):
        _branches(lengths, T[row, :3, :3], T[row, :3, 3], q[row], -1)


@nb.njit(cache=True)
def missing_reach(lengths, T, missing):
    """Fill ``missing`` (n,) in mm: how far upper arm and forearm are too short or too long for ``T`` (n, 4, 4)."""
    upper, fore, d6 = abs(lengths[1]), abs(lengths[2]), lengths[5]
    for row in range(len(T)):
        R, p = T[row, :3, :3], T[row, :3, 3]
        missing[row] = math.inf
        for side in (1.0, -1.0):
            q1 = _pan(lengths, p[0] - d6 * R[0, 2], p[1] - d6 * R[1, 2], side)
            if math.isnan(q1):
                continue
            for flip in (1.0, -1.0):
                _, _, _, x, y = _wrist(lengths, R, p, math.cos(q1), math.sin(q1), flip)
                far = math.sqrt(x * x + y * y)
                missing[row] = min(missing[row], max(far - (upper + fore), abs(upper - fore) - far, 0.0))


@nb.njit(cache=True)
def every_branch(lengths, R, target, outward, distances, q):
    """Fill ``q`` (8, m, 6): every branch at each distance (m,) from the target, without jumps of whole turns.

    NaN from where a branch first does not exist.
    """
    p, here = np.empty(3), np.empty((8, 6))
    for k in range(len(distances)):
        for i in range(3):
            p[i] = target[i] + distances[k] * outward[i]
        _branches(lengths, R, p, here, -1)
        for branch in range(8):
            for joint in range(6):
                angle = here[branch, joint]
                if k > 0:
                    before = q[branch, k - 1, joint]
                    angle = before + _wrapped(angle - before)  # NaN stays NaN
                q[branch, k, joint] = angle


@nb.njit(cache=True)
def branch_path(lengths, R, target, outward, distances, branch, turn, q):
    """Fill ``q`` (m, 6) with the path of one branch of :func:`every_branch`, ``turn`` (6,) added to every row."""
    p, here = np.empty(3), np.empty((8, 6))
    for k in range(len(distances)):
        for i in range(3):
            p[i] = target[i] + distances[k] * outward[i]
        _branches(lengths, R, p, here, branch)
        for joint in range(6):
            angle = here[branch, joint] + turn[joint]
            q[k, joint] = angle if k == 0 else q[k - 1, joint] + _wrapped(angle - q[k - 1, joint])


@nb.njit(cache=True)
def first_stop_at(lengths, path, depths, at_least, fastest):
    """Index at which a path ends: no solution, too near a singularity, or a joint faster than it may; -1: nowhere.

    Args:
        lengths: The arm.
        path: Shape (m, 6), rad.
        depths: Shape (m,), mm, rising.
        at_least: Least of the singular terms.
        fastest: rad/mm.
    """
    last = len(path) - 1
    for k in range(last + 1):
        if not _least_term(lengths, path[k]) > at_least:
            return k
        if k < last:
            for joint in range(6):
                if abs(path[k + 1, joint] - path[k, joint]) / (depths[k + 1] - depths[k]) > fastest:
                    return k
    return -1


@nb.njit(cache=True)
def _least_term(lengths, q):
    shoulder, elbow, wrist = _singular_terms(lengths, q[1], q[2], q[3], q[4])
    return min(shoulder, elbow, wrist) if not math.isnan(shoulder) else math.nan


@nb.njit(cache=True)
def path_margin(lengths, limits, full, path):
    """Least of the singular terms and of each joint's distance to its limits over ``full``, at most 1."""
    margin = 1.0
    for k in range(len(path)):
        margin = min(margin, _least_term(lengths, path[k]))
        for joint in range(6):
            to_limit = min(path[k, joint] - limits[joint, 0], limits[joint, 1] - path[k, joint])
            margin = min(margin, to_limit / full)
    return margin


@nb.njit(cache=True)
def _fast_joint(before, after, mm, fastest):
    """Whether a joint turns more than ``fastest``, rad/mm, between two configurations (6,) that lie so far apart."""
    fast = False
    for joint in range(6):
        fast |= abs(after[joint] - before[joint]) / mm > fastest
    return fast


@nb.njit(cache=True)
def survey(lengths, limits, R, target, outward, distances, depths, rolls, bounds, stops, starts, margins, turns):
    """Every branch and roll of one direction, by kinematics alone.

    Args:
        lengths: The arm.
        limits: Shape (6, 2), rad.
        R: Shape (3, 3): the flange's rotation at roll 0.
        target: Shape (3,), mm.
        outward: Shape (3,), unit.
        distances: Shape (m,), mm: target to flange.
        depths: Shape (m,), mm, rising.
        rolls: Shape (r,), rad.
        bounds: Least of the singular terms; most that a joint may turn, rad/mm; distance from a limit that counts as 1,
            rad.
        stops: Shape (8,), filled: see :func:`first_stop_at`.
        starts: Shape (8, 6), filled: the configuration at the first distance, roll 0, rad.
        margins: Shape (8, r), filled: see :func:`path_margin`; NaN where the path stops or leaves the limits.
        turns: Shape (8, r, 6), filled: what to add to the path at roll 0, rad: roll and whole turns.
    """
    at_least, fastest, full = bounds
    p, here, least = np.empty(3), np.empty((8, 6)), np.ones(8)
    before, lowest, highest, middle = np.empty((8, 6)), np.empty((8, 6)), np.empty((8, 6)), np.empty((8, 6))
    stops[:] = -1
    for k in range(len(distances)):
        for i in range(3):
            p[i] = target[i] + distances[k] * outward[i]
        _branches(lengths, R, p, here, -1)
        if k == 0:
            starts[:], before[:], lowest[:], highest[:] = here, here, here, here
        for branch in range(8):
            if stops[branch] >= 0:
                continue
            q = here[branch]
            for joint in range(6):
                q[joint] = q[joint] if k == 0 else before[branch, joint] + _wrapped(q[joint] - before[branch, joint])
            if k > 0 and _fast_joint(before[branch], q, depths[k] - depths[k - 1], fastest):
                stops[branch] = k - 1
                continue
            term = _least_term(lengths, q)
            if not term > at_least:
                stops[branch] = k
                continue
            least[branch] = min(least[branch], term)
            for joint in range(6):
                before[branch, joint] = q[joint]
                lowest[branch, joint] = min(lowest[branch, joint], q[joint])
                highest[branch, joint] = max(highest[branch, joint], q[joint])
                if k == len(distances) // 2:
                    middle[branch, joint] = q[joint]
    margins[:] = math.nan
    turns[:] = 0.0
    for branch in range(8):
        if stops[branch] < 0:
            reached = least[branch], lowest[branch], highest[branch], middle[branch]
            _rolled(limits, rolls, full, reached, margins[branch], turns[branch])


@nb.njit(cache=True)
def _rolled(limits, rolls, full, reached, margins, turns):
    """Fill ``margins`` (r,) and ``turns`` (r, 6) of one branch.

    ``reached`` holds the least singular term of its path at roll 0, each joint's lowest and highest angle and those at
    its middle (6,), rad.
    """
    least, lowest, highest, middle = reached
    for i in range(len(rolls)):
        margin = least
        for joint in range(6):
            roll = rolls[i] if joint == 5 else 0.0
            low, high = limits[joint]
            at = middle[joint] + roll
            fewest, most = math.ceil((low - at) / TURN), math.floor((high - at) / TURN)
            turn = TURN * min(max(round(((low + high) / 2.0 - at) / TURN), fewest), most)
            turns[i, joint] = roll + turn
            below, above = lowest[joint] + (roll + turn) - low, high - (highest[joint] + (roll + turn))
            margin = min(margin, below / full, above / full)
        if margin >= 0.0:
            margins[i] = margin
