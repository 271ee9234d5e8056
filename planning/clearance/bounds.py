"""Lower bounds in float32, 16 at a time: how near a needle axis can come to a disc, and to a triangle.

Every loop here is written for vectorisation: no calls, no branches, no float minimum. The slack of each bound is
derived in docs/fast-search.md.
"""

from __future__ import annotations

import numba as nb
import numpy as np

NEVER = np.float32(1e18)
"""The bound of what lies behind the target: the target's own distance covers it."""

SINE_SLACK = np.float32(1e-5)
"""Added to 1 - q^2: many times float32's rounding of it."""

COSINE_SLACK = np.float32(2e-6)
"""Added to |q|, likewise."""

TINY = np.float32(1e-30)
"""Keeps a division finite; far below any square of a length that matters."""

HUGE = np.float32(3e38)
"""More than any square of a length here."""

ROOT = np.float32(1 - 1e-6)
"""What float32 may take from a root is less than this takes."""

ZERO, ONE = np.float32(0.0), np.float32(1.0)

FAST = {"reassoc", "nsz", "contract", "arcp"}
"""What a vectoriser may do with these sums; their slack allows for it."""


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def disc_bounds(nodes, group, lanes, u, chord, length, slack, bounds, first):  # type: ignore[no-untyped-def]  # numba infers
    """Lower bounds of the distance of every axis of a cone from the 16 discs of a group.

    Args:
        nodes: Shape (groups, 10, 16), float32: centre c from the target, normal, rho, h, their hypotenuse, and
            |c| + hypotenuse.
        group: Which.
        lanes: 16, as an argument: a constant would be unrolled to scalar code.
        u: Three float32 numbers, the cone's axis.
        chord: Largest |u - axis| of the cone's members; 0 for a single direction.
        length: Of the needle, mm.
        slack: Rounding of a coordinate, mm.
        bounds: Shape (m, 16), float32; row ``first`` is written.
        first: See ``bounds``.
    """
    ux, uy, uz = u
    for k in range(lanes):
        cx, cy, cz = nodes[group, 0, k], nodes[group, 1, k], nodes[group, 2, k]
        nx, ny, nz = nodes[group, 3, k], nodes[group, 4, k], nodes[group, 5, k]
        rho, h, radius, reach = nodes[group, 6, k], nodes[group, 7, k], nodes[group, 8, k], nodes[group, 9, k]
        t = cx * ux + cy * uy + cz * uz
        wx, wy, wz = cx - t * ux, cy - t * uy, cz - t * uz
        w = np.sqrt(wx * wx + wy * wy + wz * wz)
        inverse = ONE / (w + TINY)
        q = abs(nx * wx + ny * wy + nz * wz) * inverse
        sine = np.sqrt(abs(ONE - q * q) + SINE_SLACK)
        lateral = w - rho * sine - h * (q + COSINE_SLACK) - (rho + h) * slack * inverse
        beyond = t - radius - length
        lateral = lateral if lateral > ZERO else ZERO
        beyond = beyond if beyond > ZERO else ZERO
        ahead = t + radius + chord * reach + slack
        bound = np.sqrt(lateral * lateral + beyond * beyond) * ROOT
        bound -= chord * (ahead if ahead < length else length) + slack + slack
        bounds[first, k] = bound if ahead > ZERO else NEVER


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def line_distances(local, block, lanes, e, f, ox, oy, tolerance, limit, squares):  # type: ignore[no-untyped-def]  # numba infers
    """Squared distances of a line from the triangles of a block, as they appear along the line.

    Args:
        local: Shape (b, 9, 16), float32, corners from the block's centre.
        block: Which.
        lanes: 16, as above.
        e: Three float32 numbers, first unit vector across the line.
        f: Three float32 numbers, the second.
        ox: The block's centre along e, from the line, mm.
        oy: The same along f.
        tolerance: A triangle whose edge functions all exceed this on one side counts as crossed; negative, mm^2.
        limit: Squared distances above it are of no interest, mm^2.
        squares: Shape (16,), written, mm^2.

    Returns:
        How many of the squares do not exceed the limit, as float32: an integer would halve the lanes.
    """
    count = ZERO
    ex, ey, ez = e
    fx, fy, fz = f
    for k in range(lanes):
        px, py, pz = local[block, 0, k], local[block, 1, k], local[block, 2, k]
        ax, ay = ox + px * ex + py * ey + pz * ez, oy + px * fx + py * fy + pz * fz
        px, py, pz = local[block, 3, k], local[block, 4, k], local[block, 5, k]
        bx, by = ox + px * ex + py * ey + pz * ez, oy + px * fx + py * fy + pz * fz
        px, py, pz = local[block, 6, k], local[block, 7, k], local[block, 8, k]
        cx, cy = ox + px * ex + py * ey + pz * ez, oy + px * fx + py * fy + pz * fz
        one = _square(ax, ay, bx, by)
        two = _square(bx, by, cx, cy)
        three = _square(cx, cy, ax, ay)
        one = one if one < two else two
        one = one if one < three else three
        wa, wb, wc = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
        over = (wa > tolerance) & (wb > tolerance) & (wc > tolerance)
        under = (wa < -tolerance) & (wb < -tolerance) & (wc < -tolerance)
        one = ZERO if over | under else one
        squares[k] = one
        count += ONE if one <= limit else ZERO
    return count


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def add_beyond(local, block, lanes, u, depth, slack, squares):  # type: ignore[no-untyped-def]  # numba infers
    """Add to `line_distances` what a triangle that lies wholly beyond the needle's top is away along the line.

    Args:
        local: As above.
        block: Which.
        lanes: 16, as above.
        u: Three float32 numbers, the direction of the line.
        depth: The block's centre along u, from the needle's top, mm.
        slack: Rounding of that depth, mm.
        squares: Shape (16,), changed, mm^2.
    """
    ux, uy, uz = u
    for k in range(lanes):
        ta = local[block, 0, k] * ux + local[block, 1, k] * uy + local[block, 2, k] * uz
        tb = local[block, 3, k] * ux + local[block, 4, k] * uy + local[block, 5, k] * uz
        tc = local[block, 6, k] * ux + local[block, 7, k] * uy + local[block, 8, k] * uz
        ta = ta if ta < tb else tb
        ta = ta if ta < tc else tc
        beyond = depth + ta - slack
        beyond = beyond if beyond > ZERO else ZERO
        squares[k] += beyond * beyond


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def lower_upper_bounds(frames, lanes, corners, length, error, upper):  # type: ignore[no-untyped-def]  # numba infers
    """Let one triangle lower the upper bounds of a bundle's members, all at once.

    Where the triangle lies beside the axis its nearest edge is taken, else its nearest corner.

    Args:
        frames: Shape (9, 16), float32, each member's direction u, and e and f that complete it to a frame.
        lanes: 16, as above.
        corners: Nine float32 numbers, from the target, mm.
        length: Of the needle, mm.
        error: What float32 may take from a distance, mm.
        upper: Shape (16,), float32, changed, mm.
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
        a, b, c = _past(ta, length), _past(tb, length), _past(tc, length)
        beside = (ta == a) & (tb == b) & (tc == c)
        a = ax * ax + ay * ay + (ta - a) * (ta - a)
        b = bx * bx + by * by + (tb - b) * (tb - b)
        c = cx * cx + cy * cy + (tc - c) * (tc - c)
        a = a if a < b else b
        a = a if a < c else c
        one = np.sqrt(one if beside else a) + error
        upper[k] = one if one < upper[k] else upper[k]


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def _past(t, length):  # type: ignore[no-untyped-def]  # numba infers
    """A depth, held to 0..length."""
    t = t if t > ZERO else ZERO
    return t if t < length else length


@nb.njit(cache=True, fastmath=FAST, error_model="numpy", forceinline=True)
def _square(px, py, qx, qy):  # type: ignore[no-untyped-def]  # numba infers
    """Squared distance of the origin from a segment of the plane."""
    dx, dy = qx - px, qy - py
    t = -(px * dx + py * dy) / (dx * dx + dy * dy + TINY)
    t = t if t > ZERO else ZERO
    t = t if t < ONE else ONE
    x, y = px + t * dx, py + t * dy
    return x * x + y * y
