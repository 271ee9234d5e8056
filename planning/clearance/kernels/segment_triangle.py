"""Exact distance of a needle axis from one triangle, in float64, degenerate triangles included.

The axis starts at the origin and ends at ``length * u``. Every candidate below is a point *of the triangle*, given by
non-negative weights of its corners, and its distance from the axis is evaluated honestly; so no candidate, however
badly conditioned the arithmetic that proposed it, can make the answer too small. One of them is the nearest point.
"""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb

CONTACT_MM = 1e-10
"""Below this the axis and the triangle meet: a thousand times the rounding of coordinates of 500 mm."""

LEAST = 1e-300
"""Keeps a division by the square of an edge that is a point finite, mm^2."""


@nb.njit(cache=True, error_model="numpy")
def axis_triangle(u, length, a, b, c):  # type: ignore[no-untyped-def]  # numba infers
    """Squared distance of the axis from a triangle, and the depth of the axis point nearest to it.

    Where they meet the distance is 0 and the depth that of the first meeting point found.

    Args:
        u: Unit direction, three numbers; the axis starts at the origin.
        length: Length of the axis, mm.
        a: Corner, three numbers, mm.
        b: Corner.
        c: Corner.
    """
    ux, uy, uz = u
    ax, ay, az = a
    bx, by, bz = b
    cx, cy, cz = c
    best, depth = _edge(ux, uy, uz, length, ax, ay, az, bx, by, bz)
    best, depth = _nearer(best, depth, _edge(ux, uy, uz, length, bx, by, bz, cx, cy, cz))
    best, depth = _nearer(best, depth, _edge(ux, uy, uz, length, cx, cy, cz, ax, ay, az))
    wa = _triple(ux, uy, uz, bx, by, bz, cx, cy, cz)
    wb, wc = _triple(ux, uy, uz, cx, cy, cz, ax, ay, az), _triple(ux, uy, uz, ax, ay, az, bx, by, bz)
    best, depth = _nearer(best, depth, _weighted(ux, uy, uz, length, ax, ay, az, bx, by, bz, cx, cy, cz, wa, wb, wc))
    ta, tb, tc = ax * ux + ay * uy + az * uz, bx * ux + by * uy + bz * uz, cx * ux + cy * uy + cz * uz
    for end in range(2):
        s = 0.0 if end == 0 else length
        if (end == 0 and min(ta, tb, tc) < 0.0) or (end == 1 and max(ta, tb, tc) > length):
            wa, wb, wc = _foot(s * ux, s * uy, s * uz, ax, ay, az, bx, by, bz, cx, cy, cz)
            best, depth = _nearer(
                best, depth, _weighted(ux, uy, uz, length, ax, ay, az, bx, by, bz, cx, cy, cz, wa, wb, wc)
            )
    return best, depth


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _nearer(best, depth, found):  # type: ignore[no-untyped-def]  # numba infers
    """The nearer of two candidates; of two that are equally near, the one met first."""
    if found[0] < best or (found[0] == best and found[1] < depth):
        return found[0], found[1]
    return best, depth


@nb.njit(cache=True, error_model="numpy")
def _point(ux, uy, uz, length, x, y, z):  # type: ignore[no-untyped-def]  # numba infers
    """Squared distance of a point from the axis, and the depth of the axis point nearest to it."""
    t = x * ux + y * uy + z * uz
    s = min(max(t, 0.0), length)
    px, py, pz = x - t * ux, y - t * uy, z - t * uz
    d2 = px * px + py * py + pz * pz + (t - s) * (t - s)
    return (0.0, s) if d2 < CONTACT_MM * CONTACT_MM else (d2, s)


@nb.njit(cache=True, error_model="numpy")
def _along(ux, uy, uz, length, px, py, pz, dx, dy, dz, up, down):  # type: ignore[no-untyped-def]  # numba infers
    """The candidate on the edge p + t d at t = up / down, clamped to 0..1."""
    t = up / down if down > 0.0 else 0.0
    t = min(max(t, 0.0), 1.0)
    return _point(ux, uy, uz, length, px + t * dx, py + t * dy, pz + t * dz)


@nb.njit(cache=True, error_model="numpy")
def _edge(ux, uy, uz, length, px, py, pz, qx, qy, qz):  # type: ignore[no-untyped-def]  # numba infers
    """Nearest of an edge's candidates: its corner p, and the nearest points to the line, to its start and to its end.

    The squared distance from the axis is convex and smooth along the edge, and on each of its pieces (behind the start,
    beside the axis, beyond the end) it is one of three parabolas; its minimum is that of one of them.
    """
    dx, dy, dz = qx - px, qy - py, qz - pz
    tp, td = px * ux + py * uy + pz * uz, dx * ux + dy * uy + dz * uz
    fx, fy, fz = dx - td * ux, dy - td * uy, dz - td * uz
    gx, gy, gz = px - tp * ux, py - tp * uy, pz - tp * uz
    best, depth = _point(ux, uy, uz, length, px, py, pz)
    up, down = -(gx * fx + gy * fy + gz * fz), fx * fx + fy * fy + fz * fz
    best, depth = _nearer(best, depth, _along(ux, uy, uz, length, px, py, pz, dx, dy, dz, up, down))
    low, high = min(tp, tp + td), max(tp, tp + td)
    if low < 0.0 or high > length:
        up, down = -(px * dx + py * dy + pz * dz), dx * dx + dy * dy + dz * dz
        best, depth = _nearer(best, depth, _along(ux, uy, uz, length, px, py, pz, dx, dy, dz, up, down))
        up += length * td
        best, depth = _nearer(best, depth, _along(ux, uy, uz, length, px, py, pz, dx, dy, dz, up, down))
    return best, depth


@nb.njit(cache=True, error_model="numpy")
def _triple(ux, uy, uz, px, py, pz, qx, qy, qz):  # type: ignore[no-untyped-def]  # numba infers
    """U . (p x q): on which side of the edge p-q the axis passes."""
    return ux * (py * qz - pz * qy) + uy * (pz * qx - px * qz) + uz * (px * qy - py * qx)


@nb.njit(cache=True, error_model="numpy")
def _weighted(ux, uy, uz, length, ax, ay, az, bx, by, bz, cx, cy, cz, wa, wb, wc):  # type: ignore[no-untyped-def]  # numba infers
    """The candidate with these weights, if they have one sign: then it is a point of the triangle."""
    total = wa + wb + wc
    same = (wa >= 0.0 and wb >= 0.0 and wc >= 0.0) or (wa <= 0.0 and wb <= 0.0 and wc <= 0.0)
    if not same or total == 0.0:
        return np.inf, 0.0
    wa, wb, wc = wa / total, wb / total, wc / total
    x, y, z = wa * ax + wb * bx + wc * cx, wa * ay + wb * by + wc * cy, wa * az + wb * bz + wc * cz
    return _point(ux, uy, uz, length, x, y, z)


@nb.njit(cache=True, error_model="numpy")
def _foot(qx, qy, qz, ax, ay, az, bx, by, bz, cx, cy, cz):  # type: ignore[no-untyped-def]  # numba infers
    """Weights (not normalised) of the foot of a point's perpendicular on the triangle's plane."""
    ax, ay, az, bx, by, bz, cx, cy, cz = (
        ax - qx, ay - qy, az - qz, bx - qx, by - qy, bz - qz, cx - qx, cy - qy, cz - qz,
    )  # fmt: skip
    dx, dy, dz, ex, ey, ez = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    nx, ny, nz = dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex
    return (
        _triple(nx, ny, nz, bx, by, bz, cx, cy, cz),
        _triple(nx, ny, nz, cx, cy, cz, ax, ay, az),
        _triple(nx, ny, nz, ax, ay, az, bx, by, bz),
    )
