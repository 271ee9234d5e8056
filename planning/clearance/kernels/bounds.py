"""Lower bounds in float32, 16 at a time: how near a needle axis can come to a disc, and to a triangle.

The two that are tested most are written as vectors (`lanes.py`); the loops are written for vectorisation: no calls, no
branches, no float minimum. The slack of each bound is derived in docs/concepts/fast-search.md.
"""

import numpy as np
from numba import types

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.lanes import Arguments, Vector, intrinsic, least, most

FLOAT32_TRIPLE = types.UniTuple(types.float32, 3)  # type: ignore[no-untyped-call]  # numba has no types
"""Numba's type of a direction that is handed over as three numbers."""
BOUND_BEHIND_TARGET = np.float32(1e18)
"""The bound of what lies behind the target: nothing there is nearer to an axis than to the target itself."""
SINE_SLACK = np.float32(1e-5)
"""Added to 1 - q^2: many times float32's rounding of it."""
COSINE_SLACK = np.float32(2e-6)
"""Added to |q|: many times float32's rounding of it."""
TINY = np.float32(1e-30)
"""Keeps a division finite; far below any square of a length that matters."""
HUGE = np.float32(3e38)
"""More than any square of a length here."""
ROOT_ROUNDED_DOWN = np.float32(1 - 1e-6)
"""Factor that lowers a bound by more than the rounding of its root to float32."""
DEPTH_ORDER = np.float32(1e-6)
"""Taken from a bound for each mm below the needle's top: of discs that an axis intersects (all of bound 0), the first
then has the least bound, and is tested first."""
ZERO, ONE = np.float32(0.0), np.float32(1.0)
"""Of float32: beside a Python number the arithmetic would become float64."""
FAST = {"reassoc", "nsz", "contract", "arcp"}
"""What a vectoriser may do with these sums; their slack allows for it."""


@intrinsic
def disc_bounds(  # type: ignore[no-untyped-def]  # numba's own types
    typing_context, nodes, group, u, chord, length, slack, bounds, first
):
    """Lower bounds of the distance of every axis of a cone from the 16 discs of a group.

        bound = hypot(lateral, beyond) - chord min(L, c.u + R + chord (|c| + R)) - slack
        lateral = |w| - rho sqrt(1 - q^2) - h q,    w = c - (c.u) u,    q = |n.w| / |w|,    beyond = c.u - R - L

    of a disc with centre c from the target, normal n, radius rho, half-thickness h, R = hypot(rho, h), and a needle of
    length L. A disc wholly behind the target has the bound `BOUND_BEHIND_TARGET`.

    Args:
        typing_context: Numba's; not given by the caller.
        nodes: Shape (groups, 10, 16), float32: centre c from the target, normal, rho, h, their hypotenuse, and
            |c| + hypotenuse.
        u: Three float32 numbers, the cone's axis.
        chord: Largest |u - axis| of the cone's members; 0 for a single direction.
        length: Of the needle, mm.
        slack: Rounding of a coordinate, mm.
        bounds: Shape (m, 16), float32; row ``first`` is written.
        first: See ``bounds``.
    """
    signature = types.void(nodes, types.int64, FLOAT32_TRIPLE, *(types.float32,) * 3, bounds, types.int64)
    return signature, _write_disc_bounds


def _write_disc_bounds(context, builder, signature, arguments):  # type: ignore[no-untyped-def]  # as above
    given = Arguments(context, builder, signature, arguments)
    ux, uy, uz = given.three(2)
    chord, length, slack = (given.number(place) for place in range(3, 6))
    cx, cy, cz, nx, ny, nz, rho, h, radius, reach = given.rows(0, 1, 10)
    t = cx * ux + cy * uy + cz * uz  # depth of the centre
    wx, wy, wz = cx - t * ux, cy - t * uy, cz - t * uz  # and its position across the axis
    w = (wx * wx + wy * wy + wz * wz).root()
    inverse = given.constant(1.0) / (w + TINY)
    q = abs(nx * wx + ny * wy + nz * wz) * inverse
    sine = (abs(given.constant(1.0) - q * q) + SINE_SLACK).root()
    # The last term: rounding e of w changes the sine by e / |w| at most.
    lateral = most(w - rho * sine - h * (q + COSINE_SLACK) - (rho + h) * slack * inverse, 0.0)
    beyond = most(t - radius - length, 0.0)
    ahead = t + radius + chord * reach + slack  # no point of the disc is deeper on any axis of the cone
    bound = (lateral * lateral + beyond * beyond).root() * ROOT_ROUNDED_DOWN
    bound = (ahead > 0.0).choose(bound - (chord * least(ahead, length) + slack + slack), BOUND_BEHIND_TARGET)
    given.write(6, 7, bound + (least(t, length) - length) * DEPTH_ORDER)
    return context.get_dummy_value()


@intrinsic
def line_distances(  # type: ignore[no-untyped-def]  # as above
    typing_context, local, block, e, f, ox, oy, tolerance, squares, first
):
    """Squared distances of a line from the triangles of a block, projected on the plane across the line.

    Args:
        typing_context: Numba's; not given by the caller.
        local: Shape (b, 9, 16), float32, corners from the block's centre.
        e: Three float32 numbers, first unit vector across the line.
        f: Three float32 numbers, the second.
        ox: The block's centre along e, from the line, mm.
        oy: The block's centre along f, from the line, mm.
        tolerance: Negative, mm^2: a triangle whose edge functions all exceed this on one side counts as crossed.
        squares: Shape (m, 16), float32; row ``first`` is written, mm^2.
        first: See ``squares``.
    """
    signature = types.void(
        local, types.int64, FLOAT32_TRIPLE, FLOAT32_TRIPLE, *(types.float32,) * 3, squares, types.int64
    )
    return signature, _write_line_distances


def _write_line_distances(context, builder, signature, arguments):  # type: ignore[no-untyped-def]  # as above
    given = Arguments(context, builder, signature, arguments)
    (ex, ey, ez), (fx, fy, fz) = given.three(2), given.three(3)
    ox, oy, tolerance = (given.number(place) for place in range(4, 7))
    rows = given.rows(0, 1, 9)
    shadows = []
    for px, py, pz in (rows[:3], rows[3:6], rows[6:]):
        shadows.append((ox + px * ex + py * ey + pz * ez, oy + px * fx + py * fy + pz * fz))
    (ax, ay), (bx, by), (cx, cy) = shadows
    one = least(least(_edge(ax, ay, bx, by), _edge(bx, by, cx, cy)), _edge(cx, cy, ax, ay))
    # Where the line may pass through the triangle (edge functions of one sign, up to rounding), the distance is 0: too
    # small a distance costs a float64 test, too large a one would lose the triangle.
    wa, wb, wc = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
    over = least(least(wa, wb), wc) > tolerance
    under = most(most(wa, wb), wc) < -tolerance
    one = (over | under).choose(given.constant(0.0), one)
    given.write(7, 8, one)
    return context.get_dummy_value()


def _edge(px: Vector, py: Vector, qx: Vector, qy: Vector) -> Vector:
    """Squared distances of the origin from 16 segments of the plane; `_square` of one."""
    dx, dy = qx - px, qy - py
    t = -(px * dx + py * dy) / (dx * dx + dy * dy + TINY)
    t = least(most(t, 0.0), 1.0)
    x, y = px + t * dx, py + t * dy
    return x * x + y * y


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def correct_for_ends(local, block, lanes, u, depth, length, slack, squares, first):  # type: ignore[no-untyped-def]  # numba infers
    """Correct `line_distances`, which sees a line, for the ends of the axis.

    A triangle wholly beyond the top is farther away by that; one wholly behind the target is not measured.

    Args:
        lanes: `LANES`, as an argument: a constant would be unrolled to scalar code.
        u: Three float32 numbers, the direction of the line.
        depth: The block's centre along u, mm.
        length: Of the needle, mm.
        slack: Rounding of that depth, mm.
        squares: Shape (m, 16); row ``first`` is changed, mm^2.
        first: See ``squares``.
    """
    ux, uy, uz = u
    for k in range(lanes):
        ta = local[block, 0, k] * ux + local[block, 1, k] * uy + local[block, 2, k] * uz
        tb = local[block, 3, k] * ux + local[block, 4, k] * uy + local[block, 5, k] * uz
        tc = local[block, 6, k] * ux + local[block, 7, k] * uy + local[block, 8, k] * uz
        low = ta if ta < tb else tb
        low = low if low < tc else tc
        high = ta if ta > tb else tb
        high = high if high > tc else tc
        beyond = depth - length + low - slack
        beyond = beyond if beyond > ZERO else ZERO
        square = squares[first, k] + beyond * beyond
        squares[first, k] = square if depth + high + slack >= ZERO else HUGE


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def tighten_upper_bounds(frames, lanes, corners, length, error, upper):  # type: ignore[no-untyped-def]  # numba infers
    """Lower the upper bounds of a bundle's members to their distances from one triangle, all members at once.

    Any point of the triangle gives an upper bound: where it lies next to the axis its nearest edge is taken, else its
    nearest corner.

    Args:
        frames: Shape (9, 16), float32, each member's direction u, and e and f that complete it to a frame.
        corners: Nine float32 numbers, from the target, mm.
        length: Of the axes, mm.
        error: Added to a distance for the rounding to float32, mm.
        upper: Shape (16,), float32, lowered, mm.
    """
    px, py, pz, qx, qy, qz, rx, ry, rz = corners
    for k in range(lanes):
        ux, uy, uz = frames[0, k], frames[1, k], frames[2, k]
        ex, ey, ez = frames[3, k], frames[4, k], frames[5, k]
        fx, fy, fz = frames[6, k], frames[7, k], frames[8, k]
        ta, tb, tc = px * ux + py * uy + pz * uz, qx * ux + qy * uy + qz * uz, rx * ux + ry * uy + rz * uz
        ax, ay = px * ex + py * ey + pz * ez, px * fx + py * fy + pz * fz
        bx, by = qx * ex + qy * ey + qz * ez, qx * fx + qy * fy + qz * fz
        cx, cy = rx * ex + ry * ey + rz * ez, rx * fx + ry * fy + rz * fz
        one, two, three = _square(ax, ay, bx, by), _square(bx, by, cx, cy), _square(cx, cy, ax, ay)
        one = one if one < two else two
        one = one if one < three else three
        a, b, c = _clamped(ta, length), _clamped(tb, length), _clamped(tc, length)
        lateral = (ta == a) & (tb == b) & (tc == c)  # all corners at depths of the axis
        a = ax * ax + ay * ay + (ta - a) * (ta - a)
        b = bx * bx + by * by + (tb - b) * (tb - b)
        c = cx * cx + cy * cy + (tc - c) * (tc - c)
        a = a if a < b else b
        a = a if a < c else c
        one = np.sqrt(one if lateral else a) + error
        upper[k] = one if one < upper[k] else upper[k]


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def _clamped(t, length):  # type: ignore[no-untyped-def]  # numba infers
    t = t if t > ZERO else ZERO
    return t if t < length else length


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def _square(px, py, qx, qy):  # type: ignore[no-untyped-def]  # numba infers
    dx, dy = qx - px, qy - py
    t = -(px * dx + py * dy) / (dx * dx + dy * dy + TINY)
    t = t if t > ZERO else ZERO
    t = t if t < ONE else ONE
    x, y = px + t * dx, py + t * dy
    return x * x + y * y
