"""Compiled proofs that parts of an arm are clear: by balls against the skin, by a plane between two convex hulls.

Each answer is a lower bound on a distance, in mm: above 0 it proves that nothing touches; at or below, nothing is said.
All functions that call one another stand in this one file, long as it is: numba's cache notices an edit only in the
file called.
"""

# mypy: disable-error-code="no-untyped-def"
# numba infers the types

from __future__ import annotations

import math

import numba as nb
import numpy as np

SKIN, BOX, PAIR = 0, 1, 2
"""Kinds of checks: body against skin, hull against a box of the room, hull against hull."""

MIN_GAP_MM = 1e-3
"""What a gap must exceed to prove anything: far above the rounding of these sums (1e-10 mm) and FCL's tolerance."""

ENOUGH_MM = 12.0
"""Along a path a larger gap saves questions; beyond this it is not worth a closer look."""

FAR_MM = 200.0
"""Larger distances to the skin are not told apart."""

PLANES = 4
"""Directions tried for a plane between two hulls; where it takes more, they touch or nearly do."""

COARSE_PLANES = 3
"""Directions tried on few corners first."""

CELL_MM = 16.0
"""Of the field of distances to the skin."""

HALF_CELL_MM = CELL_MM * math.sqrt(3.0) / 2.0 + 1e-3
"""No point of a cell is farther from its middle; the rounding of float32 included."""

ROUGH_MM = 8.0
"""Larger gaps are not worth all corners: a few of them stand back by 1 to 3 mm."""

OVERLAP_MM = -5.0
"""Enclosures that overlap by more are taken to touch: the judge is asked at once."""

STACK = 64
"""Of the descents: deeper than any tree here (a balanced one of 2^40 triangles needs 41)."""

ROUNDS_TO_ZERO = 1e-30
"""Squared lengths, mm^2, below which a segment has no direction."""


@nb.njit(cache=True, inline="always")
def _to_box(low, high, x, y, z):
    """Squared distance of a point to an axis-aligned box."""
    dx = max(low[0] - x, 0.0, x - high[0])
    dy = max(low[1] - y, 0.0, y - high[1])
    dz = max(low[2] - z, 0.0, z - high[2])
    return dx * dx + dy * dy + dz * dz


@nb.njit(cache=True)
def _to_segment(ax, ay, az, bx, by, bz):
    """Squared distance of the origin to the segment a b."""
    ux, uy, uz = bx - ax, by - ay, bz - az
    squared = ux * ux + uy * uy + uz * uz
    share = 0.0
    if squared > ROUNDS_TO_ZERO:
        share = min(1.0, max(0.0, -(ax * ux + ay * uy + az * uz) / squared))
    x, y, z = ax + share * ux, ay + share * uy, az + share * uz
    return x * x + y * y + z * z


@nb.njit(cache=True)
def to_triangle(t, x, y, z):
    """Squared distance of a point to a triangle (3, 3): its edges', or its plane's where the foot lies inside.

    The edges always count, so that a triangle without area, whose normal means nothing, is not lost.
    """
    ax, ay, az = t[0, 0] - x, t[0, 1] - y, t[0, 2] - z
    bx, by, bz = t[1, 0] - x, t[1, 1] - y, t[1, 2] - z
    cx, cy, cz = t[2, 0] - x, t[2, 1] - y, t[2, 2] - z
    squared = min(
        _to_segment(ax, ay, az, bx, by, bz), _to_segment(bx, by, bz, cx, cy, cz), _to_segment(cx, cy, cz, ax, ay, az)
    )
    # b x c, c x a, a x b seen from the point; their sum is the normal, and each part's sign along it the side.
    px, py, pz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    qx, qy, qz = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    rx, ry, rz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    nx, ny, nz = px + qx + rx, py + qy + ry, pz + qz + rz
    area = nx * nx + ny * ny + nz * nz
    inside = (
        px * nx + py * ny + pz * nz >= 0.0 and qx * nx + qy * ny + qz * nz >= 0.0 and rx * nx + ry * ny + rz * nz >= 0.0
    )
    if inside and area > ROUNDS_TO_ZERO:
        height = ax * nx + ay * ny + az * nz
        squared = min(squared, height * height / area)
    return squared


@nb.njit(cache=True)
def farthest_from(triangles, points):
    """The largest distance of points (n, 3) to triangles (m, 3, 3); 0 without points."""
    farthest = 0.0
    for i in range(len(points)):
        nearest = math.inf
        for k in range(len(triangles)):
            nearest = min(nearest, to_triangle(triangles[k], points[i, 0], points[i, 1], points[i, 2]))
        farthest = max(farthest, nearest)
    return math.sqrt(farthest)


@nb.njit(cache=True)
def to_surface(lows, highs, corners, x, y, z, cutoff, stack):
    """Distance of a point to a surface in a :class:`TriangleTree`, or ``cutoff`` where it is no nearer.

    ``stack`` is scratch, of ``STACK`` integers.
    """
    best = cutoff * cutoff
    inner = len(lows) - len(corners)
    stack[0] = 0
    top = 1 if _to_box(lows[0], highs[0], x, y, z) < best else 0
    while top > 0:
        top -= 1
        node = stack[top]
        if _to_box(lows[node], highs[node], x, y, z) >= best:
            continue
        if node >= inner:
            for k in range(corners.shape[1]):
                best = min(best, to_triangle(corners[node - inner, k], x, y, z))
            continue
        left, right = 2 * node + 1, 2 * node + 2
        to_left = _to_box(lows[left], highs[left], x, y, z)
        to_right = _to_box(lows[right], highs[right], x, y, z)
        near, far, to_near, to_far = left, right, to_left, to_right
        if to_right < to_left:
            near, far, to_near, to_far = right, left, to_right, to_left
        if to_far < best:
            stack[top] = far
            top += 1
        if to_near < best:
            stack[top] = near
            top += 1
    return math.sqrt(best)


@nb.njit(cache=True)
def _moved(T, c):
    """A point (3,) where the frame ``T`` (4, 4) takes it."""
    x = T[0, 0] * c[0] + T[0, 1] * c[1] + T[0, 2] * c[2] + T[0, 3]
    y = T[1, 0] * c[0] + T[1, 1] * c[1] + T[1, 2] * c[2] + T[1, 3]
    z = T[2, 0] * c[0] + T[2, 1] * c[1] + T[2, 2] * c[2] + T[2, 3]
    return x, y, z


@nb.njit(cache=True)
def _field_distance(tree, field, origin, x, y, z, stack):
    """Distance to the skin of the middle of the cell that a point lies in: kept in ``field`` once known; -1 outside."""
    i, j, k = (x - origin[0]) / CELL_MM, (y - origin[1]) / CELL_MM, (z - origin[2]) / CELL_MM
    if not (0.0 <= i < field.shape[0] and 0.0 <= j < field.shape[1] and 0.0 <= k < field.shape[2]):
        return -1.0
    i, j, k = int(i), int(j), int(k)
    if math.isnan(field[i, j, k]):
        lows, highs, corners = tree
        mx, my, mz = (i + 0.5) * CELL_MM, (j + 0.5) * CELL_MM, (k + 0.5) * CELL_MM
        field[i, j, k] = to_surface(lows, highs, corners, origin[0] + mx, origin[1] + my, origin[2] + mz, 1e9, stack)
    return field[i, j, k]


@nb.njit(cache=True)
def skin_gap(skin, balls, root, T, enough, far, needed, stack, inner_stack):
    """Lower bound on the distance of a body's balls to the skin, the body's frame standing at ``T`` (4, 4).

    The field is asked first: a ball's centre is no farther from the middle of its cell than half of its diagonal. A
    ball as clear as ``enough``, mm, is not divided further; no bound exceeds ``far``; the first part that is not clear
    by ``needed`` ends the search. Both stacks are scratch.
    """
    tree, field, origin = skin
    centres, radii, children = balls
    best = far
    stack[0], top = root, 1
    while top > 0 and best > needed:
        top -= 1
        node = stack[top]
        c, r = centres[node], radii[node]
        x, y, z = _moved(T, c)
        about = _field_distance(tree, field, origin, x, y, z, inner_stack)
        if about >= 0.0:
            if about - HALF_CELL_MM - r >= best:
                continue
            if about + HALF_CELL_MM + r <= needed:  # no part of the body in this ball is clear by as much
                return 0.0
        gap = to_surface(tree[0], tree[1], tree[2], x, y, z, best + r, inner_stack) - r
        if gap >= best:
            continue
        if gap > enough or children[node, 0] < 0:
            best = gap
        else:
            stack[top], stack[top + 1] = children[node, 0], children[node, 1]
            top += 2
    return best


@nb.njit(cache=True, fastmath={"nnan", "ninf", "nsz", "reassoc", "contract"})
def _extreme(px, py, pz, x, y, z):
    """The largest projection of points on a direction. Its inputs are finite: that lets it run four abreast."""
    best = -1e300
    for i in range(len(px)):
        best = max(best, x * px[i] + y * py[i] + z * pz[i])
    return best


@nb.njit(cache=True)
def _support(px, py, pz, x, y, z):
    """Index of the point farthest along a direction."""
    best, at = -math.inf, 0
    for i in range(len(px)):
        along = x * px[i] + y * py[i] + z * pz[i]
        if along > best:
            best, at = along, i
    return at


@nb.njit(cache=True)
def plane_gap(a, b, R, t, axis, needed, tries):
    """The gap between two hulls along the best direction found: a plane square to it stands between them if above 0.

    0 says nothing: the search ended where two points of the hulls were too close for the gap needed.

    The direction is mirrored at the line through the two extreme points until it parts the hulls (Chung and Wang 1996).

    Args:
        a: Corners of the one, mm: three arrays (n,), x, y and z, so that each lies in one piece.
        b: Corners of the other in its own frame, the same.
        R: Shape (3, 3): the other's axes in the frame of the one.
        t: Shape (3,), mm: its origin there.
        axis: Shape (3,), unit, in the frame of the one: where to begin; replaced by where it ended.
        needed: A gap above this will do, mm.
        tries: Directions tried at most.
    """
    best = -math.inf
    for _ in range(tries):
        x, y, z = axis
        bx = R[0, 0] * x + R[1, 0] * y + R[2, 0] * z
        by = R[0, 1] * x + R[1, 1] * y + R[2, 1] * z
        bz = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
        gap = x * t[0] + y * t[1] + z * t[2] - _extreme(b[0], b[1], b[2], -bx, -by, -bz)
        gap -= _extreme(a[0], a[1], a[2], x, y, z)
        best = max(best, gap)
        if gap > needed:
            return gap
        i = _support(a[0], a[1], a[2], x, y, z)
        j = _support(b[0], b[1], b[2], -bx, -by, -bz)
        qx, qy, qz = b[0][j], b[1][j], b[2][j]
        rx = R[0, 0] * qx + R[0, 1] * qy + R[0, 2] * qz + t[0] - a[0][i]
        ry = R[1, 0] * qx + R[1, 1] * qy + R[1, 2] * qz + t[1] - a[1][i]
        rz = R[2, 0] * qx + R[2, 1] * qy + R[2, 2] * qz + t[2] - a[2][i]
        squared = rx * rx + ry * ry + rz * rz
        if squared < ROUNDS_TO_ZERO:
            return best
        if squared <= needed * abs(needed):  # two points of the hulls: no gap is larger
            return max(best, 0.0)
        twice = 2.0 * (rx * x + ry * y + rz * z) / squared
        x, y, z = x - twice * rx, y - twice * ry, z - twice * rz
        size = math.sqrt(x * x + y * y + z * z)
        axis[0], axis[1], axis[2] = x / size, y / size, z / size
    return best


@nb.njit(cache=True)
def _between(A, B, R, t):
    """``R`` and ``t`` of frame B seen from frame A; both (4, 4)."""
    for i in range(3):
        t[i] = 0.0
        for k in range(3):
            t[i] += A[k, i] * (B[k, 3] - A[k, 3])
            R[i, k] = A[0, i] * B[0, k] + A[1, i] * B[1, k] + A[2, i] * B[2, k]


@nb.njit(cache=True)
def _hull(points, starts, row):
    """The corners of one hull, mm: x, y and z."""
    x, y, z = points
    begin, end = starts[row], starts[row + 1]
    return x[begin:end], y[begin:end], z[begin:end]


@nb.njit(cache=True)
def ball_gap(frames, row, frame_a, frame_b, centres, radii, first, second):
    """Distance between the balls of two hulls whose frames stand at ``frames`` (m, 7, 4, 4) in state ``row``, mm."""
    squared = 0.0
    for i in range(3):
        apart = frames[row, frame_b, i, 3] - frames[row, frame_a, i, 3]
        for k in range(3):
            apart += frames[row, frame_b, i, k] * centres[second, k] - frames[row, frame_a, i, k] * centres[first, k]
        squared += apart * apart
    return math.sqrt(squared) - radii[first] - radii[second]


@nb.njit(cache=True)
def box_gap(frames, row, frame_b, centres, radii, second, poses, halves, first):
    """Distance of a hull's ball to a cuboid: ``poses`` (h, 4, 4) takes the room to its frame; half sizes (h, 3)."""
    squared = 0.0
    for i in range(3):
        along = poses[first, i, 3]
        for k in range(3):
            at = frames[row, frame_b, k, 3]
            for j in range(3):
                at += frames[row, frame_b, k, j] * centres[second, j]
            along += poses[first, i, k] * at
        squared += max(0.0, abs(along) - halves[first, i]) ** 2
    return math.sqrt(squared) - radii[second]


@nb.njit(cache=True)
def hull_gap(points, coarse, hulls, first, second, A, B, axis, needed):
    """Lower bound on the distance of two hulls, by a plane between them.

    Args:
        points: The corners of all hulls, mm: three arrays (n,), x, y and z.
        coarse: The same for fewer corners of each.
        hulls: (starts (h + 1,), centres (h, 3), radii (h,), starts (h + 1,) of the coarse, slack (h,)): no corner lies
            farther than its slack, mm, outside the hull of the coarse ones.
        first: The one.
        second: The other.
        A: Frame of the one, (4, 4).
        B: Frame of the other, (4, 4).
        axis: See :func:`plane_gap`; where it is zero, the line through the centres is taken.
        needed: A gap above this will do, mm; for one above ``ROUGH_MM`` the coarse corners must suffice.
    """
    starts, centres, _, coarse_starts, slack = hulls
    R, t = np.empty((3, 3)), np.empty(3)
    _between(A, B, R, t)
    if axis[0] == 0.0 and axis[1] == 0.0 and axis[2] == 0.0:
        for i in range(3):
            axis[i] = t[i] - centres[first, i]
            for k in range(3):
                axis[i] += R[i, k] * centres[second, k]
        size = math.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
        if size > 0.0:
            axis /= size
        else:
            axis[2] = 1.0
    fuller = slack[first] + slack[second]
    a, b = _hull(coarse, coarse_starts, first), _hull(coarse, coarse_starts, second)
    gap = plane_gap(a, b, R, t, axis, fuller + needed, COARSE_PLANES) - fuller
    if gap > needed or needed > ROUGH_MM:
        return gap
    return plane_gap(_hull(points, starts, first), _hull(points, starts, second), R, t, axis, needed, PLANES)


@nb.njit(cache=True)
def _gap(scene, at, frames, row, axis, enough, far, needed, stacks):
    """Lower bound on the distance of check ``at`` in state ``row``; see :func:`skin_gap` and :func:`hull_gap`."""
    checks, skin, balls, points, coarse, hulls, boxes = scene
    kind, first, second, frame_a, frame_b = checks[at]
    if kind == SKIN:
        return skin_gap(skin, balls, second, frames[row, frame_b], enough, far, needed, stacks[0], stacks[1])
    _, centres, radii, _, _ = hulls
    if kind == BOX:
        gap = box_gap(frames, row, frame_b, centres, radii, second, boxes[0], boxes[1], first)
    else:
        gap = ball_gap(frames, row, frame_a, frame_b, centres, radii, first, second)
    if gap <= enough:
        gap = hull_gap(points, coarse, hulls, first, second, frames[row, frame_a], frames[row, frame_b], axis, needed)
    return gap


@nb.njit(cache=True)
def first_unproven(scene, levers, motion, axes, proven, state, check, asked, clear_mm):
    """The first state and check, in order, that the bounds do not prove to be more than ``clear_mm`` apart.

    A check whose gap was g stays clear until its two bodies have moved by g - ``clear_mm`` against one another.

    Args:
        scene: (checks, skin, balls, points, coarse, hulls, boxes), with
            checks: Shape (k, 5): kind, first, second, and the frames of both. For SKIN ``second`` is the row of the
            body's root among the balls;
            skin: ((lows, highs, corners) of its tree, its field (i, j, k), NaN where nobody has asked yet, and the
            field's lowest corner (3,));
            balls: (centres, radii, children) of all bodies' trees, each in the frame of its body;
            points, coarse, hulls: See :func:`hull_gap`;
            boxes: (T_box_base (h, 4, 4), half sizes (h, 3)) by hull; half sizes -1 where it is no box.
        levers: Shape (k, 6), mm: how far a radian of each joint may move the two bodies of a PAIR.
        motion: (frames, moved, turned), with
            frames: Shape (m, 7, 4, 4), mm: the states;
            moved: Shape (m, 7), mm: how far each frame's bodies may have moved since the first state; rising;
            turned: Shape (m, 6), rad: how far each joint has turned since the first state; rising.
        axes: Shape (k, 3): scratch, the last direction of each check.
        proven: Shape (k,): scratch, mm: what the motion must stay below; -inf at the beginning.
        state: Where to begin.
        check: The first check there.
        asked: Shape (k,): which checks.
        clear_mm: ``MIN_GAP_MM``, or any other distance that is asked for.

    Returns:
        state * k + check; -1 where all is clear.
    """
    checks = scene[0]
    frames, moved, turned = motion
    count = len(checks)
    enough, far = (clear_mm + ENOUGH_MM, clear_mm + FAR_MM) if len(frames) > 1 else (clear_mm, clear_mm + MIN_GAP_MM)
    stacks = np.empty((2, STACK), np.int64)
    for row in range(state, len(frames)):
        for at in range(check if row == state else 0, count):
            frame_a, frame_b = checks[at, 3], checks[at, 4]
            way = moved[row, frame_b]
            if checks[at, 0] == PAIR:
                way = 0.0
                for joint in range(frame_a, frame_b):
                    way += levers[at, joint] * turned[row, joint]
            if way < proven[at] or not asked[at]:
                continue
            gap = _gap(scene, at, frames, row, axes[at], enough, far, clear_mm, stacks)
            if gap <= clear_mm:
                proven[at] = -math.inf
                return row * count + at
            proven[at] = way + gap - clear_mm
    return -1


@nb.njit(cache=True)
def _ways(frames, row, body_frame, centre, radius, turns, ways):
    """How far a body may move while each joint turns by no more than ``turns`` (6,), rad, either way from a state.

    Fills ``ways`` (7,), mm: entry j bounds the motion against the frame before joint j. A point's distance from axis j
    is at most that of the body's ball, plus what the joints beyond have moved it against that axis.
    """
    x, y, z = _moved(frames[row, body_frame], centre)
    ways[body_frame] = 0.0
    for joint in range(body_frame - 1, -1, -1):
        T = frames[row, joint]
        dx, dy, dz = x - T[0, 3], y - T[1, 3], z - T[2, 3]
        ax, ay, az = T[0, 2], T[1, 2], T[2, 2]
        cx, cy, cz = dy * az - dz * ay, dz * ax - dx * az, dx * ay - dy * ax
        lever = math.sqrt(cx * cx + cy * cy + cz * cz) + radius + ways[joint + 1]
        ways[joint] = ways[joint + 1] + turns[joint] * lever


@nb.njit(cache=True)
def bisect(scene, movers, frames, turns, unproven, fine_mm, axes, questions):
    """Prove parts of a straight joint segment clear: at the middle of each part, else of its halves, and so on.

    A check that is farther apart at the middle than its bodies move from there to the part's ends is clear all over the
    part (Schwarzer, Saha and Latombe 2005, "Adaptive dynamic collision checking for single and multiple articulated
    robots in complex environments").

    Args:
        scene: See :func:`first_unproven`.
        movers: (mover (k,), frame (b,), centres (b, 3), radii (b,)): what moves in each check, the frame that it moves
            with, and a ball about it there.
        frames: Shape (c, n, 7, 4, 4), mm: for each of c parts the state in its middle, in the middle of its halves, of
            their halves ..., as a heap of n nodes.
        turns: Shape (6,), rad: how far each joint turns from the middle of a part to its end.
        unproven: Shape (c, 2 n + 1, k): True at node 0 where a check is open; filled for all nodes and, beyond, for
            the parts that the last nodes' halves are.
        fine_mm: Where the bodies of a check move no farther than this within a part, its middle decides.
        axes: See :func:`first_unproven`.
        questions: Shape (q, 3): filled with part, node and check of what a judge must be asked at the node's state.

    Returns:
        How many questions; more than q where they did not fit.
    """
    checks = scene[0]
    mover_of, mover_frames, centres, radii = movers
    stacks, ways = np.empty((2, STACK), np.int64), np.empty((len(mover_frames), 7))
    fresh = np.empty(len(mover_frames), np.bool_)
    asked = 0
    for part in range(len(frames)):
        share, level_ends = 1.0, 1
        for node in range(frames.shape[1]):
            if node == level_ends:
                share, level_ends = share / 2.0, 2 * level_ends + 1
            here, left, right = unproven[part, node], unproven[part, 2 * node + 1], unproven[part, 2 * node + 2]
            fresh[:] = True
            for at in range(len(checks)):
                left[at] = right[at] = False
                if not here[at]:
                    continue
                mover = mover_of[at]
                if fresh[mover]:
                    fresh[mover] = False
                    ball = centres[mover], radii[mover]
                    _ways(frames[part], node, mover_frames[mover], *ball, share * turns, ways[mover])
                way = ways[mover, checks[at, 3]] + MIN_GAP_MM
                gap = _gap(scene, at, frames[part], node, axes[at], way, way + MIN_GAP_MM, way, stacks)
                if gap > way:
                    continue
                axes[at] = 0.0  # where a direction did not do, the next search begins anew
                coarse = way - MIN_GAP_MM > fine_mm
                left[at] = right[at] = coarse
                if gap < OVERLAP_MM or (gap <= MIN_GAP_MM and not coarse):
                    if asked < len(questions):
                        questions[asked] = part, node, at
                    asked += 1
    return asked
