"""Exact distances of many axes from many triangles, in float64, pair by pair.

Each pair is brought into the frame of its axis. Most triangles lie next to their axis, at depths of 0 to its length:
there the distance is that of their projection on the plane across it. These are all measured in one loop without a
branch, the few others singly. As in `segment_triangle.py`, every distance is that of a point *of the triangle*.

`Scratch` holds the working arrays of the search of one structure.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.segment_triangle import CONTACT_MM, LEAST_SQUARE_MM2, axis_triangle

PAIR_ROWS = 12
"""Rows of a buffer of pairs: nine coordinates, squared distance, depth, length of the axis."""
UNDECIDED, BEYOND = -1.0, -2.0
"""Marks in place of a squared distance: left to `axis_triangle`; the triangle lies wholly beyond the axis' top."""


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def bring_into_frame(u, e, f, triangles, row, origin, pairs, k):  # type: ignore[no-untyped-def]  # numba infers
    """Write a triangle's corners, seen from an axis, to ``pairs[:9, k]``: across (e, f) and along (u), mm."""
    for corner in range(3):
        x, y = triangles[row, 3 * corner] - origin[0], triangles[row, 3 * corner + 1] - origin[1]
        z = triangles[row, 3 * corner + 2] - origin[2]
        pairs[3 * corner, k] = x * e[0] + y * e[1] + z * e[2]
        pairs[3 * corner + 1, k] = x * f[0] + y * f[1] + z * f[2]
        pairs[3 * corner + 2, k] = x * u[0] + y * u[1] + z * u[2]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def measure_lateral(pairs, count):  # type: ignore[no-untyped-def]  # numba infers
    """Measure the pairs whose triangle lies next to the axis or is pierced by it; mark the others.

    Args:
        pairs: Shape (12, m); rows 0 to 8 as `bring_into_frame` writes them, row 11 the axes' lengths; rows 9
            and 10 are written: squared distance (or `UNDECIDED`, `BEYOND`), and the depth of the axis' nearest point.
    """
    for k in range(count):  # selects, no branches: the compiler makes vectors of it
        ax, ay, ta, bx, by, tb = pairs[0, k], pairs[1, k], pairs[2, k], pairs[3, k], pairs[4, k], pairs[5, k]
        cx, cy, tc, length = pairs[6, k], pairs[7, k], pairs[8, k], pairs[11, k]
        # The axis is the origin of the plane across it: the distance of the projected edges from there.
        best, depth = _shadow(ax, ay, ta, bx, by, tb)
        two, two_depth = _shadow(bx, by, tb, cx, cy, tc)
        three, three_depth = _shadow(cx, cy, tc, ax, ay, ta)
        depth, best = two_depth if two < best else depth, two if two < best else best
        depth, best = three_depth if three < best else depth, three if three < best else best
        # Edge functions: of one sign where the line passes through the triangle; over their sum, the point's weights.
        wa, wb, wc = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
        around = ((wa >= 0.0) & (wb >= 0.0) & (wc >= 0.0)) | ((wa <= 0.0) & (wb <= 0.0) & (wc <= 0.0))
        outside = (ta < 0.0) | (tb < 0.0) | (tc < 0.0) | (ta > length) | (tb > length) | (tc > length)
        fraction = 1.0 / (wa + wb + wc)  # of a sum of 0 not finite: every comparison below is then false
        x, y = (wa * ax + wb * bx + wc * cx) * fraction, (wa * ay + wb * by + wc * cy) * fraction
        pierced = (wa * ta + wb * tb + wc * tc) * fraction
        pierces = around & (x * x + y * y < CONTACT_MM * CONTACT_MM) & (pierced >= 0.0) & (pierced <= length)
        pierces &= best >= CONTACT_MM  # else the axis may run along the triangle's plane and intersect it earlier
        best = UNDECIDED if around | outside | (best < CONTACT_MM) else best
        best = BEYOND if (ta > length) & (tb > length) & (tc > length) else best
        pairs[9, k], pairs[10, k] = 0.0 if pierces else best, pierced if pierces else depth


@nb.njit(cache=True, error_model="numpy")
def measure_marked(pairs, k):  # type: ignore[no-untyped-def]  # numba infers
    """Squared distance and depth of a pair that `measure_lateral` has marked."""
    a, b, c = (pairs[0, k], pairs[1, k], pairs[2, k]), (pairs[3, k], pairs[4, k], pairs[5, k]), (
        pairs[6, k], pairs[7, k], pairs[8, k],
    )  # fmt: skip
    length = pairs[11, k]
    if pairs[9, k] == BEYOND:  # the nearest axis point is the top
        top = (0.0, 0.0, length)
        return _origin_triangle(_minus(a, top), _minus(b, top), _minus(c, top)), length
    return axis_triangle((0.0, 0.0, 1.0), length, a, b, c)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _shadow(px, py, tp, qx, qy, tq):  # type: ignore[no-untyped-def]  # numba infers
    """Squared distance of the origin from an edge p-q projected across the axis, and the depth of its nearest point.

    ``tp`` and ``tq`` are the depths of p and q.
    """
    dx, dy = qx - px, qy - py
    t = -(px * dx + py * dy) / (dx * dx + dy * dy + LEAST_SQUARE_MM2)
    t = t if t > 0.0 else 0.0
    t = t if t < 1.0 else 1.0
    x, y = px + t * dx, py + t * dy
    return x * x + y * y, tp + t * (tq - tp)


@nb.njit(cache=True, error_model="numpy")
def _origin_triangle(a, b, c):  # type: ignore[no-untyped-def]  # numba infers
    """Squared distance of the origin from a triangle: from its nearest edge, or its face where the foot is inside."""
    best = min(_origin_edge(a, b), _origin_edge(b, c), _origin_edge(c, a))
    n = _cross(_minus(b, a), _minus(c, a))
    wa, wb, wc = _inner(n, _cross(b, c)), _inner(n, _cross(c, a)), _inner(n, _cross(a, b))
    total = wa + wb + wc
    if not (wa >= 0.0 and wb >= 0.0 and wc >= 0.0 and total > 0.0):
        return best
    wa, wb, wc = wa / total, wb / total, wc / total
    x, y = wa * a[0] + wb * b[0] + wc * c[0], wa * a[1] + wb * b[1] + wc * c[1]
    z = wa * a[2] + wb * b[2] + wc * c[2]
    return min(best, x * x + y * y + z * z)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _origin_edge(p, q):  # type: ignore[no-untyped-def]  # numba infers
    d = _minus(q, p)
    t = -_inner(p, d) / (_inner(d, d) + LEAST_SQUARE_MM2)
    t = min(max(t, 0.0), 1.0)
    x, y, z = p[0] + t * d[0], p[1] + t * d[1], p[2] + t * d[2]
    return x * x + y * y + z * z


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _minus(p, q):  # type: ignore[no-untyped-def]  # numba infers
    return p[0] - q[0], p[1] - q[1], p[2] - q[2]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _inner(p, q):  # type: ignore[no-untyped-def]  # numba infers
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _cross(p, q):  # type: ignore[no-untyped-def]  # numba infers
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


NODE_ROWS = 10
"""Of a group of nodes, see `bounds.disc_bounds`."""
PAIRS = 64
"""Pairs of a direction and a block that are tested side by side."""
CACHE_PADDING = 8
"""Columns added to a row of ``corners``: rows of a power of two would all compete for the same cache lines."""


class Scratch(NamedTuple):
    """Scratch arrays for one bundle of at most 16 directions."""

    blocks: NDArray[np.int64]  # shape (r,), the blocks that may come near to some member of the bundle
    chosen: NDArray[np.float32]  # shape (g, 10, 16), float32, the nodes of these blocks, in groups
    bounds: NDArray[np.float32]
    """Shape (16 g, 16), float32, their bounds: of member m and group j in row m g' + j, g' groups being used."""
    stack: NDArray[np.int64]
    """Shape (512, 2), groups of the tree that are still to visit, and their level."""
    frames: NDArray[np.float64]
    """Shape (9, 16), each member's direction u, and e and f that complete it to a frame."""
    frames32: NDArray[np.float32]  # ``frames`` as float32
    upper: NDArray[np.float32]  # shape (16,), float32, upper bound of each member's distance, mm
    pairs: NDArray[np.int64]  # shape (64, 2), members, and rows of ``blocks``
    squares: NDArray[np.float32]
    """Shape (64, 16), float32, squared distances of each pair's axis from its 16 triangles, mm^2."""
    least: NDArray[np.float32]  # shape (64,), float32, the least of each pair's ``squares``
    errors: NDArray[np.float32]
    """Shape (64,), float32, how much the root of a pair's ``squares`` may err, mm."""
    tried: NDArray[np.int64]  # shape (1024, 2), members, and rows of triangles
    corners: NDArray[np.float64]  # shape (12, 1032), see `measure_lateral`


class SearchOutput(NamedTuple):
    """Output of a search: squared distance (mm^2), depth (mm), nearest triangle of each axis; counts as `COUNTED`."""

    square: NDArray[np.float64]
    depth: NDArray[np.float64]
    triangle: NDArray[np.int64]
    counts: NDArray[np.int64]


class NeedleAxes(NamedTuple):
    """Start and length of the axes of a search."""

    target: Any  # three numbers, where all start, mm
    length: Any  # shape (n,), of each axis, in the bundles' order, mm
    longest: Any  # length of the longest axis of the bundle, float32, mm
    slack: Any  # rounding of a node's coordinate, float32, mm
