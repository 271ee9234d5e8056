"""Compiled decisions of single checks: clear, or certainly a contact; FCL is queried where neither is proven.

Where the bounds of :mod:`puncture_twin.planning.collision.kernels.proofs` prove nothing, two more tests follow. Two
hulls certainly overlap where some differences of their corners enclose the origin; holder and needle are tested against
each triangle of the skin near them.
"""

# mypy: disable-error-code="no-untyped-def"
# numba infers the types

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.numba_kernels import allocation_free
from puncture_twin.planning.collision.kernels.hulls import TOUCHING, Hulls, deep, distance_bounds
from puncture_twin.planning.collision.kernels.proofs import MIN_GAP_MM, SKIN, near_gap, place_spheres, state_gap

CLEAR, OPEN, TOUCHES, TOUCHES_OUTSIDE = 0, 1, 2, 3
"""What a check came to: no contact, the reference is to be queried, a contact, one with what the CT shows besides the
skin while the skin itself is clear."""

DEEP_MM = 1e-3
"""Two bodies surely touch where they overlap by more: far above the rounding of these sums (1e-10 mm) and FCL's
tolerance."""

SLIVER = 1e-6
"""Of the product of two edges over the sum of their squares: what is less has a normal that is mostly rounding, so its
plane need not hold it. Of what is more, rounding (1e-16 of those squares) moves the plane by 1e-9 of the edges at most:
a thousandth of ``MIN_GAP_MM`` for edges of a metre."""


class Triangle(NamedTuple):
    """All corners of :class:`Hulls` and behind them the three of a triangle, which takes part as one more hull."""

    corners: Floats
    """Shape (n + 3, 3), mm; the last three are filled in turn."""
    inner: Floats
    """Shape (n + 3, 3), mm, likewise: see :class:`Hulls`."""
    starts: Ints
    ends: Ints
    """Of each corner the neighbours, see :class:`Hulls`."""
    axis: Floats
    at: Ints
    S: Floats
    """Scratch, see :func:`distance_bounds`."""
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
    """Whether a box is farther than ``reach`` from a segment, by the box and by the sphere about it.

    The box is given by its lowest and its highest corner; ``line`` holds the segment's middle, its unit direction and
    half of its length.
    """
    (mx, my, mz), (ux, uy, uz), half = line
    ex, ey, ez = (hx - lx) / 2.0, (hy - ly) / 2.0, (hz - lz) / 2.0
    x, y, z = lx + ex - mx, ly + ey - my, lz + ez - mz
    if (
        abs(x) > ex + half * abs(ux) + reach
        or abs(y) > ey + half * abs(uy) + reach
        or abs(z) > ez + half * abs(uz) + reach
    ):
        return True
    along = min(half, max(-half, x * ux + y * uy + z * uz))
    x, y, z = x - along * ux, y - along * uy, z - along * uz
    return x * x + y * y + z * z > (reach + math.sqrt(ex * ex + ey * ey + ez * ez)) ** 2


@allocation_free()
def _far_triangle(t, line, reach):
    """As :func:`_far`, of the box about a triangle (3, 3)."""
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
    height = abs((mx - t[0, 0]) * nx + (my - t[0, 1]) * ny + (mz - t[0, 2]) * nz)
    return height - half * abs(ux * nx + uy * ny + uz * nz) > reach * size


@allocation_free()
def _mean(corners, begin, end):
    """The mean of some rows of corners (n, 3), as three numbers."""
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
    """The axis of the round body in a hull at ``T`` (4, 4): see :func:`_far`; and a radius that holds it.

    The hull is a prism: the corners of one end come before those of the other.
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
    """The gap between a triangle (3, 3) and a hull at ``M``, along a direction, by all corners."""
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
def against_triangle(hulls, hull, M, triangle, line, room):
    """Whether the round body in a hull touches a triangle: ``CLEAR``, ``TOUCHES``, or ``OPEN`` if undecided.

    Args:
        hulls: See :class:`Hulls`.
        hull: Row of the body's prism.
        M: Shape (3, 4) or (4, 4), mm: pose of its frame.
        triangle: Shape (3, 3), mm: its corners.
        line: The body's axis, see :func:`_far`.
        room: See :class:`Triangle`.
    """
    count, axis, at = len(hulls.corners), room.axis, room.at
    (mx, my, mz), (ux, uy, uz), half = line
    for k in range(3):
        for i in range(3):
            room.corners[count + k, i], room.inner[count + k, i] = triangle[k, i], triangle[k, i]
    x = mx - (triangle[0, 0] + triangle[1, 0] + triangle[2, 0]) / 3.0
    y = my - (triangle[0, 1] + triangle[1, 1] + triangle[2, 1]) / 3.0
    z = mz - (triangle[0, 2] + triangle[1, 2] + triangle[2, 2]) / 3.0
    along = min(half, max(-half, -(x * ux + y * uy + z * uz)))
    x, y, z = x + along * ux, y + along * uy, z + along * uz
    size = math.sqrt(x * x + y * y + z * z)
    axis[0], axis[1], axis[2] = (x / size, y / size, z / size) if size > MIN_GAP_MM else (ux, uy, uz)
    at[0], at[1] = count, hulls.starts[hull]
    lower, _ = distance_bounds(room.corners, room.starts, room.ends, M, axis, at, MIN_GAP_MM, room.S)
    if lower > MIN_GAP_MM:
        return CLEAR if _gap_along(hulls, hull, M, triangle, axis[0], axis[1], axis[2]) > MIN_GAP_MM else OPEN
    if lower == TOUCHING:
        lower, _ = distance_bounds(room.inner, room.starts, room.ends, M, axis, at, 0.0, room.S)
    return TOUCHES if lower == TOUCHING and deep(room.S, DEEP_MM) else OPEN


@allocation_free()
def on_skin(skin, hulls, hull, T, room):
    """Result of the round body in a hull at ``T`` (4, 4) against each triangle of the skin.

    It touches as soon as one triangle of the skin does. What the CT shows besides counts where all of the skin is
    clear.
    """
    lows, highs, corners = skin.tree
    line, reach = _axis(hulls, hull, T)
    inner, stack, top = len(lows) - len(corners), room.stack, 1
    on_it, beside = CLEAR, CLEAR
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
            if outside and beside == TOUCHES:
                continue
            if _far_triangle(triangle, line, reach) or _beyond_plane(triangle, line, reach):
                continue
            answer = against_triangle(hulls, hull, T, triangle, line, room)
            if outside:
                beside = max(beside, answer)
            elif answer == TOUCHES:
                return TOUCHES
            else:
                on_it = max(on_it, answer)
    if on_it == OPEN or beside == OPEN:
        return OPEN
    return CLEAR if beside == CLEAR else TOUCHES_OUTSIDE


@allocation_free()
def settled(scene, work, room, at, frames, gap):
    """Result of a check whose bound ``gap`` proves nothing, the arm at ``frames`` (7, 4, 4).

    Of a bound that is ``TOUCHING``, ``work`` is as the bound has left it.
    """
    first = scene.checks[at, 1]
    if scene.checks[at, 0] != SKIN:
        return TOUCHES if gap == TOUCHING and deep(work.S, DEEP_MM) else OPEN
    return OPEN if first < 0 else on_skin(scene.skin, scene.hulls, first, frames[scene.checks[at, 4]], room)


@allocation_free()
def settled_at(scene, work, room, at, frames):
    """Result of a check, the arm at ``frames`` (7, 4, 4)."""
    gap = near_gap(scene, work, at, frames, MIN_GAP_MM, 2.0 * MIN_GAP_MM, MIN_GAP_MM)
    return CLEAR if gap > MIN_GAP_MM else settled(scene, work, room, at, frames, gap)


@allocation_free()
def first_not_clear(scene, frames, work, room, tested, of_state, begins, found, answers):
    """First check that is not proven clear at each of some independent states.

    Args:
        scene: See :class:`ProofScene`.
        frames: Shape (m, 7, 4, 4), mm: the states.
        work: See :class:`ProofScratch`.
        room: See :class:`Triangle`.
        tested: Shape (t, k): which checks, in so many choices.
        of_state: Shape (m,): which of the choices.
        begins: Shape (m,): the first check at each state; k to pass it over.
        found: Shape (m,), filled; -1 where all from there on is clear.
        answers: Shape (m,), filled: what the check that was found comes to; ``CLEAR`` where there is none.
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
                answers[row] = settled(scene, work, room, at, frames[row], gap)
                if answers[row] != CLEAR:
                    found[row] = at
                    break
