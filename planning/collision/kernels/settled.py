"""Compiled decisions of single checks: clear, certainly a contact, or left to FCL where neither is proven.

The bounds of :mod:`puncture_twin.planning.collision.kernels.proofs` come first. Where they prove nothing, two more
tests follow: two hulls certainly overlap where four differences of their corners enclose the origin (GJK); holder and
needle, which are round, are tested against each triangle of the skin near them.
"""

# mypy: disable-error-code="no-untyped-def"
# numba infers the types

import math
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.numba_kernels import allocation_free
from puncture_twin.planning.collision.kernels.hulls import TOUCHING, Hulls, deep, distance_bounds
from puncture_twin.planning.collision.kernels.proofs import (
    MIN_GAP_MM,
    SKIN,
    first_unproven,
    near_gap,
    place_spheres,
    state_gap,
)

CLEAR, OPEN, TOUCHES, TOUCHES_OUTSIDE = 0, 1, 2, 3
"""Results of a check: no contact; undecided, FCL is to be queried; a contact; a contact with what the CT shows outside
of the patient, the skin being clear."""
DEEP_MM = 1e-3
"""Overlap from which on two bodies certainly touch: far above the rounding of these sums (1e-10 mm) and FCL's
tolerance. Between it and ``MIN_GAP_MM`` FCL decides."""
SLIVER = 1e-6
"""Length of a triangle's cross product of edges over the sum of their squares, below which it is a sliver: its normal
is mostly rounding. Above, rounding (1e-16 of those squares) moves the plane by 1e-9 of the edges at most, a thousandth
of ``MIN_GAP_MM`` for edges of a metre."""


class Triangle(NamedTuple):
    """Scratch in which a triangle is one more hull: the corners of :class:`Hulls`, then the triangle's three."""

    corners: Floats  # shape (n + 3, 3), mm; the last three are filled in turn
    inner: Floats
    """Shape (n + 3, 3), mm: corners of the enclosed hulls, see :class:`Hulls`, and of the triangle."""
    starts: Ints
    ends: Ints  # of each corner the neighbours, see :class:`Hulls`
    axis: Floats
    at: Ints
    S: Floats  # scratch, see :func:`distance_bounds`
    stack: Ints


def triangle_scratch(hulls: Hulls, stack: int) -> Triangle:
    """Scratch for a triangle tested against hulls, and for a descent as deep as ``stack``."""
    count, spare = len(hulls.corners), np.zeros((3, 3))
    starts = np.concatenate([hulls.neighbour_starts, hulls.neighbour_starts[-1] + np.array([2, 4, 6])])
    ends = np.concatenate([hulls.neighbours, count + np.array([1, 2, 0, 2, 0, 1])])
    corners, inner = np.concatenate([hulls.corners, spare]), np.concatenate([hulls.inner, spare])
    scratch = np.zeros(3), np.zeros(2, np.int64), np.zeros((4, 3)), np.empty(stack, np.int64)
    return Triangle(corners, inner, starts, ends, *scratch)


@allocation_free()
def _far(lx, ly, lz, hx, hy, hz, line, reach):
    """Whether a box is certainly farther than ``reach`` from a segment: by its extents, or by the sphere about it.

    The box is given by its lowest and its highest corner; ``line`` holds the segment's middle, its unit direction and
    half of its length, mm.
    """
    (mx, my, mz), (ux, uy, uz), half = line
    ex, ey, ez = (hx - lx) / 2.0, (hy - ly) / 2.0, (hz - lz) / 2.0
    x, y, z = lx + ex - mx, ly + ey - my, lz + ez - mz
    if (
        abs(x) > ex + half * abs(ux) + reach
        or abs(y) > ey + half * abs(uy) + reach
        or abs(z) > ez + half * abs(uz) + reach
    ):
        return True  # their extents along one axis of the frame are apart
    along = min(half, max(-half, x * ux + y * uy + z * uz))  # of the segment's point nearest to the sphere's centre
    x, y, z = x - along * ux, y - along * uy, z - along * uz
    return x * x + y * y + z * z > (reach + math.sqrt(ex * ex + ey * ey + ez * ez)) ** 2


@allocation_free()
def _far_triangle(t, line, reach):
    """Whether the box about a triangle (3, 3) is far from a segment: see :func:`_far`."""
    lx, ly, lz = min(t[0, 0], t[1, 0], t[2, 0]), min(t[0, 1], t[1, 1], t[2, 1]), min(t[0, 2], t[1, 2], t[2, 2])
    hx, hy, hz = max(t[0, 0], t[1, 0], t[2, 0]), max(t[0, 1], t[1, 1], t[2, 1]), max(t[0, 2], t[1, 2], t[2, 2])
    return _far(lx, ly, lz, hx, hy, hz, line, reach)


@allocation_free()
def _beyond_plane(t, line, reach):
    """Whether a segment lies on one side of the plane of a triangle (3, 3), farther than ``reach`` from it.

    Never for a triangle that is a sliver: see ``SLIVER``.
    """
    (mx, my, mz), (ux, uy, uz), half = line
    ax, ay, az = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
    bx, by, bz = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    size = math.sqrt(nx * nx + ny * ny + nz * nz)
    if not size > SLIVER * (ax * ax + ay * ay + az * az + bx * bx + by * by + bz * bz):
        return False
    # Height of the segment's nearer end above the plane, times |n|: no root, and no division by a small one.
    height = abs((mx - t[0, 0]) * nx + (my - t[0, 1]) * ny + (mz - t[0, 2]) * nz)
    return height - half * abs(ux * nx + uy * ny + uz * nz) > reach * size


@allocation_free()
def _mean(corners, begin, end):
    x, y, z, count = 0.0, 0.0, 0.0, end - begin
    for row in range(begin, end):
        x, y, z = x + corners[row, 0] / count, y + corners[row, 1] / count, z + corners[row, 2] / count
    return x, y, z


@allocation_free()
def _farthest(corners, begin, end, x, y, z):
    """The largest distance of some rows of corners (n, 3) from a point."""
    squared = 0.0
    for row in range(begin, end):
        dx, dy, dz = corners[row, 0] - x, corners[row, 1] - y, corners[row, 2] - z
        squared = max(squared, dx * dx + dy * dy + dz * dz)
    return math.sqrt(squared)


@allocation_free()
def _axis(hulls, hull, T):
    """Axis of the round body in a hull at ``T`` (4, 4), as the ``line`` of :func:`_far`, and a radius that contains it.

    The hull is a prism about the axis: the corners of one end come before those of the other.
    """
    begin, end = hulls.starts[hull], hulls.starts[hull + 1]
    middle, corners = (begin + end) // 2, hulls.corners
    ax, ay, az = _mean(corners, begin, middle)
    bx, by, bz = _mean(corners, middle, end)
    radius = max(_farthest(corners, begin, middle, ax, ay, az), _farthest(corners, middle, end, bx, by, bz))
    length = math.sqrt((bx - ax) ** 2 + (by - ay) ** 2 + (bz - az) ** 2)
    x, y, z = (bx - ax) / length, (by - ay) / length, (bz - az) / length
    u = (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z,
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z,
    )
    x, y, z = (ax + bx) / 2.0, (ay + by) / 2.0, (az + bz) / 2.0
    m = (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
    )
    return (m, u, length / 2.0), radius + MIN_GAP_MM


@allocation_free()
def _gap_along(hulls, hull, M, triangle, x, y, z):
    """Gap between a triangle (3, 3) and a hull at ``M``, projected on a direction, over all corners, mm.

    A positive one proves that they are apart (separating axis).
    """
    far = -math.inf
    for k in range(3):
        far = max(far, triangle[k, 0] * x + triangle[k, 1] * y + triangle[k, 2] * z)
    bx = M[0, 0] * x + M[1, 0] * y + M[2, 0] * z
    by = M[0, 1] * x + M[1, 1] * y + M[2, 1] * z
    bz = M[0, 2] * x + M[1, 2] * y + M[2, 2] * z
    near = math.inf
    for row in range(hulls.starts[hull], hulls.starts[hull + 1]):
        near = min(near, hulls.corners[row, 0] * bx + hulls.corners[row, 1] * by + hulls.corners[row, 2] * bz)
    return near + M[0, 3] * x + M[1, 3] * y + M[2, 3] * z - far


@allocation_free()
def against_triangle(hulls, hull, M, triangle, line, scratch):
    """Whether the round body in a hull touches a triangle: ``CLEAR``, ``TOUCHES``, or ``OPEN`` if undecided.

    Args:
        M: Shape (3, 4) or (4, 4), mm: pose of its frame.
        triangle: Shape (3, 3), mm: its corners.
    """
    count, axis, at = len(hulls.corners), scratch.axis, scratch.at
    (mx, my, mz), (ux, uy, uz), half = line
    for k in range(3):  # the triangle is the hull behind all others
        for i in range(3):
            scratch.corners[count + k, i], scratch.inner[count + k, i] = triangle[k, i], triangle[k, i]
    # GJK starts along the line from the triangle's middle to the nearest point of the axis: mostly the answer.
    x = mx - (triangle[0, 0] + triangle[1, 0] + triangle[2, 0]) / 3.0
    y = my - (triangle[0, 1] + triangle[1, 1] + triangle[2, 1]) / 3.0
    z = mz - (triangle[0, 2] + triangle[1, 2] + triangle[2, 2]) / 3.0
    along = min(half, max(-half, -(x * ux + y * uy + z * uz)))
    x, y, z = x + along * ux, y + along * uy, z + along * uz
    size = math.sqrt(x * x + y * y + z * z)
    axis[0], axis[1], axis[2] = (x / size, y / size, z / size) if size > MIN_GAP_MM else (ux, uy, uz)
    at[0], at[1] = count, hulls.starts[hull]
    lower, _ = distance_bounds(scratch.corners, scratch.starts, scratch.ends, M, axis, at, MIN_GAP_MM, scratch.S)
    if lower > MIN_GAP_MM:  # GJK has seen some corners; `_gap_along` asks all of them along its direction
        return CLEAR if _gap_along(hulls, hull, M, triangle, axis[0], axis[1], axis[2]) > MIN_GAP_MM else OPEN
    if lower == TOUCHING:  # the enclosing prism touches; a contact is certain where the enclosed one does too
        lower, _ = distance_bounds(scratch.inner, scratch.starts, scratch.ends, M, axis, at, 0.0, scratch.S)
    return TOUCHES if lower == TOUCHING and deep(scratch.S, DEEP_MM) else OPEN


@allocation_free()
def on_skin(skin, hulls, hull, T, scratch):
    """Result of the round body in a hull at ``T`` (4, 4) against the skin, triangle by triangle.

    One triangle of the skin in contact decides. Triangles outside of the patient count only where all of the skin is
    clear.
    """
    lows, highs, corners = skin.tree
    line, reach = _axis(hulls, hull, T)
    inner, stack, top = len(lows) - len(corners), scratch.stack, 1  # a full binary tree: the leaves come last
    on_skin_result, outside_result = CLEAR, CLEAR
    stack[0] = 0
    while top > 0:
        top -= 1
        node = stack[top]
        low, high = lows[node], highs[node]
        if _far(low[0], low[1], low[2], high[0], high[1], high[2], line, reach):
            continue
        if node < inner:
            stack[top], stack[top + 1] = 2 * node + 1, 2 * node + 2
            top += 2
            continue
        for k in range(corners.shape[1]):
            triangle, outside = corners[node - inner, k], skin.outside[node - inner, k]
            if outside and outside_result == TOUCHES:
                continue
            if _far_triangle(triangle, line, reach) or _beyond_plane(triangle, line, reach):
                continue
            answer = against_triangle(hulls, hull, T, triangle, line, scratch)
            if outside:
                outside_result = max(outside_result, answer)  # CLEAR < OPEN < TOUCHES
            elif answer == TOUCHES:
                return TOUCHES
            else:
                on_skin_result = max(on_skin_result, answer)
    if on_skin_result == OPEN or outside_result == OPEN:
        return OPEN
    return CLEAR if outside_result == CLEAR else TOUCHES_OUTSIDE


@allocation_free()
def settled(scene, work, scratch, at, frames, gap):
    """Result of a check whose bound ``gap`` proves nothing, the arm at ``frames`` (7, 4, 4).

    Where ``gap`` is ``TOUCHING``, ``work.S`` must still hold the simplex that encloses the origin.
    """
    first = scene.checks[at, 1]
    if scene.checks[at, 0] != SKIN:  # hull against hull: a contact where the simplex holds the origin deep enough
        return TOUCHES if gap == TOUCHING and deep(work.S, DEEP_MM) else OPEN
    return OPEN if first < 0 else on_skin(scene.skin, scene.hulls, first, frames[scene.checks[at, 4]], scratch)


@allocation_free()
def settled_at(scene, work, scratch, at, frames):
    """Result of one check, the arm at ``frames`` (7, 4, 4): by its bound, else by `settled`."""
    gap = near_gap(scene, work, at, frames, MIN_GAP_MM, 2.0 * MIN_GAP_MM, MIN_GAP_MM)
    return CLEAR if gap > MIN_GAP_MM else settled(scene, work, scratch, at, frames, gap)


@allocation_free()
def next_not_clear(scene, levers, motion, work, scratch, due, tested):
    """The next state and check of a motion that are not proven clear, and the result of that check.

    The arguments are those of `first_unproven`; a further call goes on from there. Returns state * k + check, -1 where
    all that is left is clear, and the result.
    """
    while True:
        at = first_unproven(scene, levers, motion, work, due, tested, MIN_GAP_MM)
        if at < 0:
            return at, CLEAR
        answer = settled_at(scene, work, scratch, at % len(due), motion[0][at // len(due)])
        if answer != CLEAR:
            return at, answer


@allocation_free()
def first_not_clear(scene, frames, work, scratch, tested, of_state, begins, found, answers):
    """Find the first check that is not proven clear at each of some independent states.

    Args:
        frames: Shape (m, 7, 4, 4), mm: the states.
        tested: Shape (t, k): t selections of checks.
        of_state: Shape (m,): which selection holds at each state.
        begins: Shape (m,): the check to begin with at each state; k skips the state.
        found: Shape (m,), filled: the check; -1 where all from ``begins`` on are clear.
        answers: Shape (m,), filled: the result of that check; ``CLEAR`` where there is none.
    """
    for row in range(len(frames)):
        found[row], answers[row] = -1, CLEAR
        if begins[row] < len(scene.checks):
            place_spheres(scene.hulls, frames[row], work.spheres)
        for at in range(begins[row], len(scene.checks)):
            if not tested[of_state[row], at]:
                continue
            gap = state_gap(scene, work, at, frames[row], MIN_GAP_MM, 2.0 * MIN_GAP_MM, MIN_GAP_MM)
            if not gap > MIN_GAP_MM:
                answers[row] = settled(scene, work, scratch, at, frames[row], gap)
                if answers[row] != CLEAR:
                    found[row] = at
                    break
