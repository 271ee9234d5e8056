"""Compiled distances to a surface of triangles: of points, and of a tree of bounding spheres that encloses a body.

Each bound for a body is a lower bound, mm: above 0 it proves that nothing touches; else it proves nothing.
"""

# mypy: disable-error-code="no-untyped-def"
# numba infers the types

import math

from puncture_twin.planning.base.numba_kernels import allocation_free
from puncture_twin.planning.geometry.triangle_distance import to_triangle

CELL_MM = 16.0
"""mm: edge of a cell in the field of distances to the skin."""
HALF_CELL_MM = CELL_MM * math.sqrt(3.0) / 2.0 + 1e-3
"""No point of a cell is farther from its middle; the rounding of float32 included."""
ROUGH = 0.9
"""The distance of a cell's middle from the skin is at least this fraction of the field's value. Far from a surface an
exact search spends its time on many triangles that are equally near within less than a cell."""
STACK = 64
"""Depth of the descents: deeper than any tree here (a balanced one of 2^40 triangles needs 41)."""


@allocation_free(inline="always")
def _to_box(low, high, x, y, z):
    dx = max(low[0] - x, 0.0, x - high[0])
    dy = max(low[1] - y, 0.0, y - high[1])
    dz = max(low[2] - z, 0.0, z - high[2])
    return dx * dx + dy * dy + dz * dz


@allocation_free()
def boxes_near(lows, highs, R, t, low, high, slack, near):
    """Whether each of some boxes, ``lows`` and ``highs`` (n, 3), meets the box about a body: ``near`` (n,), filled.

    The body's box, from ``low`` to ``high`` (3,) in its own frame, stands at ``R`` (3, 3) and ``t`` (3,); the box about
    it has the axes of the others, and is ``slack`` wider on each side. Returns whether any does.
    """
    found = False
    for row in range(len(lows)):
        near[row] = True
        for i in range(3):
            middle, reach = t[i], slack
            for k in range(3):
                middle += R[i, k] * 0.5 * (low[k] + high[k])
                reach += abs(R[i, k]) * 0.5 * (high[k] - low[k])
            if highs[row, i] < middle - reach or lows[row, i] > middle + reach:
                near[row] = False
                break
        found = found or near[row]
    return found


@allocation_free()
def points_within(points, R, t, low, high, within):
    """Whether each of some points (n, 3) lies in a body's box, see `boxes_near`: ``within`` (n,), filled; if any."""
    found = False
    for row in range(len(points)):
        within[row] = True
        x, y, z = points[row, 0] - t[0], points[row, 1] - t[1], points[row, 2] - t[2]
        for k in range(3):
            at = x * R[0, k] + y * R[1, k] + z * R[2, k]
            if at < low[k] or at > high[k]:
                within[row] = False
                break
        found = found or within[row]
    return found


@allocation_free()
def to_surface(lows, highs, corners, x, y, z, cutoff, stack, stop, fraction):
    """Distance of a point to a surface in a :class:`TriangleTree`, or ``cutoff`` where it is no nearer.

    Where it is no farther than ``stop`` any distance up to that may be returned. The distance is no less than a
    ``fraction``, 0 to 1, of what is returned, and no more; 1 for the distance itself. ``stack`` is scratch, of
    ``STACK`` integers.
    """
    best, squared = cutoff * cutoff, fraction * fraction
    inner = len(lows) - len(corners)  # a full binary tree: inner nodes first, the children of n at 2 n + 1 and 2 n + 2
    stack[0] = 0
    top = 1 if _to_box(lows[0], highs[0], x, y, z) < squared * best else 0
    while top > 0 and best > stop * stop:
        top -= 1
        node = stack[top]
        if _to_box(lows[node], highs[node], x, y, z) >= squared * best:
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
        if to_far < squared * best:  # pushed first, so the nearer child is visited next
            stack[top] = far
            top += 1
        if to_near < squared * best:
            stack[top] = near
            top += 1
    return math.sqrt(best)


@allocation_free()
def moved(T, c):
    """The point T c, of a pose (4, 4) and a point (3,), as three numbers."""
    x = T[0, 0] * c[0] + T[0, 1] * c[1] + T[0, 2] * c[2] + T[0, 3]
    y = T[1, 0] * c[0] + T[1, 1] * c[1] + T[1, 2] * c[2] + T[1, 3]
    z = T[2, 0] * c[0] + T[2, 1] * c[1] + T[2, 2] * c[2] + T[2, 3]
    return x, y, z


@allocation_free()
def _field_distance(tree, field, origin, x, y, z, stack):
    """Distance to the skin, within ``ROUGH``, of the middle of a point's cell, cached in ``field``; -1 outside."""
    i, j, k = (x - origin[0]) / CELL_MM, (y - origin[1]) / CELL_MM, (z - origin[2]) / CELL_MM
    if not (0.0 <= i < field.shape[0] and 0.0 <= j < field.shape[1] and 0.0 <= k < field.shape[2]):
        return -1.0
    i, j, k = int(i), int(j), int(k)
    if math.isnan(field[i, j, k]):
        lows, highs, corners = tree
        mx, my, mz = (i + 0.5) * CELL_MM, (j + 0.5) * CELL_MM, (k + 0.5) * CELL_MM
        field[i, j, k] = to_surface(
            lows, highs, corners, origin[0] + mx, origin[1] + my, origin[2] + mz, 1e9, stack, 0.0, ROUGH
        )
    return field[i, j, k]


@allocation_free()
def skin_gap(skin, spheres, root, T, enough, far, needed, stack, inner_stack):
    """Lower bound on the distance of a body's spheres to the skin, the body's frame at ``T`` (4, 4); mm.

    The field is asked first: a sphere's centre is within half of a cell's diagonal of its cell's middle. Where that
    proves more than ``enough``, or a sphere is farther than ``enough``, no closer look is taken. No bound exceeds
    ``far``. The first sphere that cannot be clear by ``needed`` ends the search: the result is then no bound, only no
    more than ``needed``. Both stacks are scratch.
    """
    tree, field, origin = skin.tree, skin.field, skin.origin
    centres, radii, children = spheres
    best = far
    stack[0], top = root, 1
    while top > 0 and best > needed:
        top -= 1
        node = stack[top]
        c, r = centres[node], radii[node]
        x, y, z = moved(T, c)
        field_mm, cutoff = _field_distance(tree, field, origin, x, y, z, inner_stack), best + r
        if field_mm >= 0.0:
            at_least = ROUGH * field_mm - HALF_CELL_MM - r  # lower bound of the sphere's distance, by the field
            if at_least >= best:  # it cannot lower the result
                continue
            if at_least > enough:
                best = at_least
                continue
            if field_mm + HALF_CELL_MM + r <= needed:  # no part of the body in this sphere is clear by as much
                return 0.0
            cutoff = min(cutoff, field_mm + HALF_CELL_MM)
        stop = max(0.0, needed + r)  # nearer than this the exact distance does not matter
        gap = to_surface(tree[0], tree[1], tree[2], x, y, z, cutoff, inner_stack, stop, 1.0) - r
        if gap >= best:
            continue
        if gap > enough or children[node, 0] < 0:  # clear enough, or a leaf
            best = gap
        else:  # two smaller spheres enclose the body more tightly
            stack[top], stack[top + 1] = children[node, 0], children[node, 1]
            top += 2
    return best
