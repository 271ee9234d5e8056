"""Exact distance of a needle axis from triangles, in float64, degenerate triangles included.

The axis starts at the origin and ends at ``length * u``. Every candidate below is a point *of the triangle*, given by
non-negative weights of its corners, and its distance from the axis is computed from that point. So no candidate,
however badly conditioned, can make the distance too small; and one of them is the nearest point (`axis_triangle`).

`displaced_distance` measures axes displaced by little from the few faces near them; spheres around faces, and around
blocks of 16, tell which faces may be skipped.
"""

import math

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.lanes import LANES

CONTACT_MM = 1e-10
"""Nearer than this the axis and the triangle intersect: a thousand times the rounding of coordinates of 500 mm."""
LEAST_SQUARE_MM2 = 1e-300
"""Keeps a division by the square of an edge that is a point finite, mm^2."""


@nb.njit(cache=True, error_model="numpy")
def axis_triangle(u, length, a, b, c):  # type: ignore[no-untyped-def]  # numba infers
    """Squared distance of the axis from a triangle, and the depth of the axis point nearest to it.

    Where they intersect the distance is 0 and the depth the least of the candidates that intersect.

    Args:
        u: Unit direction, three numbers; the axis starts at the origin.
        length: Length of the axis, mm.
        a: Corner, three numbers, mm.
    """
    ux, uy, uz = u
    ax, ay, az = a
    bx, by, bz = b
    cx, cy, cz = c
    # Candidates 1 to 3: the nearest point of each edge.
    best, depth = _edge(ux, uy, uz, length, ax, ay, az, bx, by, bz)
    best, depth = _nearer(best, depth, _edge(ux, uy, uz, length, bx, by, bz, cx, cy, cz))
    best, depth = _nearer(best, depth, _edge(ux, uy, uz, length, cx, cy, cz, ax, ay, az))
    # Candidate 4: where the line pierces the face; the edge functions there are the point's weights.
    wa = _triple(ux, uy, uz, bx, by, bz, cx, cy, cz)
    wb, wc = _triple(ux, uy, uz, cx, cy, cz, ax, ay, az), _triple(ux, uy, uz, ax, ay, az, bx, by, bz)
    best, depth = _nearer(best, depth, _weighted(ux, uy, uz, length, ax, ay, az, bx, by, bz, cx, cy, cz, wa, wb, wc))
    ta, tb, tc = ax * ux + ay * uy + az * uz, bx * ux + by * uy + bz * uz, cx * ux + cy * uy + cz * uz
    # Candidates 5 and 6: the foot on the face of each end of the axis, where the triangle reaches beyond that end.
    for end in range(2):
        s = 0.0 if end == 0 else length
        if (end == 0 and min(ta, tb, tc) < 0.0) or (end == 1 and max(ta, tb, tc) > length):
            wa, wb, wc = _foot(s * ux, s * uy, s * uz, ax, ay, az, bx, by, bz, cx, cy, cz)
            best, depth = _nearer(
                best, depth, _weighted(ux, uy, uz, length, ax, ay, az, bx, by, bz, cx, cy, cz, wa, wb, wc)
            )
    return best, depth


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _nearer(best, depth, candidate):  # type: ignore[no-untyped-def]  # numba infers
    """The nearer of two candidates; of two that are equally near, that of lesser depth."""
    if candidate[0] < best or (candidate[0] == best and candidate[1] < depth):
        return candidate[0], candidate[1]
    return best, depth


@nb.njit(cache=True, error_model="numpy")
def _point(ux, uy, uz, length, x, y, z):  # type: ignore[no-untyped-def]  # numba infers
    """Squared distance of a point from the axis, and the depth of the axis point nearest to it."""
    t = x * ux + y * uy + z * uz
    s = min(max(t, 0.0), length)
    # Across and along apart: |p - s u|^2 at once would lose what is small across to what is large along.
    px, py, pz = x - t * ux, y - t * uy, z - t * uz
    d2 = px * px + py * py + pz * pz + (t - s) * (t - s)
    return (0.0, s) if d2 < CONTACT_MM * CONTACT_MM else (d2, s)


@nb.njit(cache=True, error_model="numpy")
def _along(ux, uy, uz, length, px, py, pz, dx, dy, dz, up, down):  # type: ignore[no-untyped-def]  # numba infers
    """The candidate on the edge p + t d at t = up / down, clamped to 0..1."""
    t = up / down if down > 0.0 else 0.0  # an edge that is a point, or parallel to the axis
    t = min(max(t, 0.0), 1.0)
    return _point(ux, uy, uz, length, px + t * dx, py + t * dy, pz + t * dz)


@nb.njit(cache=True, error_model="numpy")
def _edge(ux, uy, uz, length, px, py, pz, qx, qy, qz):  # type: ignore[no-untyped-def]  # numba infers
    """Nearest of an edge's candidates: its corner p, and the nearest points to the line, to its start and to its end.

    The squared distance from the axis is convex and smooth along the edge, and on each of its pieces (behind the start,
    next to the axis, beyond the end) it is one of three parabolas; its minimum is that of one of them.
    """
    dx, dy, dz = qx - px, qy - py, qz - pz
    tp, td = px * ux + py * uy + pz * uz, dx * ux + dy * uy + dz * uz
    fx, fy, fz = dx - td * ux, dy - td * uy, dz - td * uz  # d across the axis
    gx, gy, gz = px - tp * ux, py - tp * uy, pz - tp * uz  # p across the axis
    best, depth = _point(ux, uy, uz, length, px, py, pz)
    up, down = -(gx * fx + gy * fy + gz * fz), fx * fx + fy * fy + fz * fz  # nearest to the line: least |g + t f|
    best, depth = _nearer(best, depth, _along(ux, uy, uz, length, px, py, pz, dx, dy, dz, up, down))
    low, high = min(tp, tp + td), max(tp, tp + td)
    if low < 0.0 or high > length:
        up, down = -(px * dx + py * dy + pz * dz), dx * dx + dy * dy + dz * dz  # to the start: least |p + t d|
        best, depth = _nearer(best, depth, _along(ux, uy, uz, length, px, py, pz, dx, dy, dz, up, down))
        up += length * td  # to the end: least |p + t d - length u|
        best, depth = _nearer(best, depth, _along(ux, uy, uz, length, px, py, pz, dx, dy, dz, up, down))
    return best, depth


@nb.njit(cache=True, error_model="numpy")
def _triple(ux, uy, uz, px, py, pz, qx, qy, qz):  # type: ignore[no-untyped-def]  # numba infers
    """Triple product u . (p x q): its sign is the side of the edge p-q on which the axis passes."""
    return ux * (py * qz - pz * qy) + uy * (pz * qx - px * qz) + uz * (px * qy - py * qx)


@nb.njit(cache=True, error_model="numpy")
def _weighted(ux, uy, uz, length, ax, ay, az, bx, by, bz, cx, cy, cz, wa, wb, wc):  # type: ignore[no-untyped-def]  # numba infers
    """The candidate with these weights of a, b and c, if they have one sign: then it is a point of the triangle."""
    total = wa + wb + wc
    same = (wa >= 0.0 and wb >= 0.0 and wc >= 0.0) or (wa <= 0.0 and wb <= 0.0 and wc <= 0.0)
    if not same or total == 0.0:
        return np.inf, 0.0
    wa, wb, wc = wa / total, wb / total, wc / total
    x, y, z = wa * ax + wb * bx + wc * cx, wa * ay + wb * by + wc * cy, wa * az + wb * bz + wc * cz
    return _point(ux, uy, uz, length, x, y, z)


@nb.njit(cache=True, error_model="numpy")
def _foot(qx, qy, qz, ax, ay, az, bx, by, bz, cx, cy, cz):  # type: ignore[no-untyped-def]  # numba infers
    """Weights (not normalised) of the foot of q's perpendicular on the triangle's plane: where q + t n pierces it."""
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


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def beyond(sphere, ox, oy, oz, ux, uy, uz, length, best):  # type: ignore[no-untyped-def]
    """Whether no point of a sphere (centre, radius) is nearer to the axis than ``best``."""
    x, y, z = sphere[0] - ox, sphere[1] - oy, sphere[2] - oz
    s = min(max(x * ux + y * uy + z * uz, 0.0), length)
    x, y, z = x - s * ux, y - s * uy, z - s * uz
    limit = best + sphere[3]
    return x * x + y * y + z * z >= limit * limit


@nb.njit(cache=True, error_model="numpy")
def displaced_distance(triangles, faces, blocks, origin, outward, length, enough, hint):  # type: ignore[no-untyped-def]
    """Distance of an axis from faces, mm, and the row of the nearest; or of some face nearer than ``enough``.

    Args:
        triangles: Shape (m, 9), corners, mm.
        faces: Shape (m, 4), spheres around them.
        blocks: Shape (m / 16, 4), around each 16 of them.
        origin: Three numbers, where the axis starts, mm.
        outward: Three numbers, unit.
        length: Of the axis, mm.
        enough: The search ends at a face nearer than this, mm; negative to find the nearest.
        hint: Row to begin with, the last axis' nearest: the better the first distance, the more is skipped.
    """
    ox, oy, oz = origin
    ux, uy, uz = outward
    best, nearest = np.inf, hint
    if len(triangles) > 0:
        best = _face(triangles, hint, ox, oy, oz, outward, length)
    for block in range(len(blocks)):
        if best < enough:
            break
        if beyond(blocks[block], ox, oy, oz, ux, uy, uz, length, best):
            continue
        for row in range(block * LANES, (block + 1) * LANES):
            if not beyond(faces[row], ox, oy, oz, ux, uy, uz, length, best):
                distance = _face(triangles, row, ox, oy, oz, outward, length)
                if distance < best:
                    best, nearest = distance, row
    return best, nearest


@nb.njit(cache=True, error_model="numpy")
def _face(triangles, row, ox, oy, oz, outward, length):  # type: ignore[no-untyped-def]
    t = triangles[row]
    a, b, c = (t[0] - ox, t[1] - oy, t[2] - oz), (t[3] - ox, t[4] - oy, t[5] - oz), (t[6] - ox, t[7] - oy, t[8] - oz)
    return math.sqrt(axis_triangle(outward, length, a, b, c)[0])


@nb.njit(cache=True, error_model="numpy")
def displaced_distances(triangles, faces, blocks, origins, outward, length, distance):  # type: ignore[no-untyped-def]
    """Fill the distances (n,) of axes from ``origins`` (n, 3) along ``outward`` (n, 3)."""
    hint = 0
    for i in range(len(origins)):
        origin = (origins[i, 0], origins[i, 1], origins[i, 2])
        along = (outward[i, 0], outward[i, 1], outward[i, 2])
        distance[i], hint = displaced_distance(triangles, faces, blocks, origin, along, length, -1.0, hint)


LEAST_TILT = 1e-3
"""Below, the reach grows nearly as fast as the axis goes on, and only its whole change bounds it (`blocks_near`)."""
RADIUS_ROUNDED_UP = 1 + 1e-9
"""Factor that raises a sphere's radius by more than the rounding of centre and radius."""


@nb.njit(cache=True, error_model="numpy")
def blocks_near(center, disc, count, origin, outward, length, reach):  # type: ignore[no-untyped-def]  # numba infers
    """Rows of the blocks that may lie within reach of an axis, and a lower bound of each one's distance less the reach.

    Args:
        center: Shape (nodes, 3), of `Blocks`, mm; the first are the blocks.
        disc: Shape (5, nodes), of `Blocks`.
        origin: Shape (3,), where the axis starts, mm.
        outward: Shape (3,), unit.
        length: Of the axis, mm.
        reach: At its start and at its end, mm; linear in between.
    """
    near, bounds, n_near = np.empty(count, np.int64), np.empty(count), 0
    start, slope = reach[0], (reach[1] - reach[0]) / max(length, 1e-9)
    tilt = math.sqrt(max(1.0 - slope * slope, 0.0))
    for block in range(count):
        x, y, z = center[block, 0] - origin[0], center[block, 1] - origin[1], center[block, 2] - origin[2]
        radius = math.hypot(disc[3, block], disc[4, block]) * (1 + 1e-6)
        along = x * outward[0] + y * outward[1] + z * outward[2]
        across = math.sqrt(max(x * x + y * y + z * z - along * along, 0.0))
        # least of |c - s u| - reach(s) over the axis, which is convex in s
        s = min(max(along + slope * across / max(tilt, LEAST_TILT), 0.0), length)
        bound = math.hypot(across, along - s) - slope * s if tilt > LEAST_TILT else -abs(slope) * length
        if bound - radius <= start:
            near[n_near], bounds[n_near] = block, bound - radius
            n_near += 1
    return near[:n_near], bounds[:n_near]


@nb.njit(cache=True, error_model="numpy")
def spheres_around(triangles, faces, blocks):  # type: ignore[no-untyped-def]
    """Fill spheres (m, 4) around faces (m, 9), and (m / 16, 4) around each 16 of them: centre and radius, mm."""
    for row in range(len(triangles)):
        t = triangles[row]
        _sphere(t.reshape(3, 3), faces[row])
    for block in range(len(blocks)):
        _sphere(triangles[block * LANES : (block + 1) * LANES].reshape(3 * LANES, 3), blocks[block])


@nb.njit(cache=True, error_model="numpy")
def _sphere(points, sphere):  # type: ignore[no-untyped-def]
    """Fill a sphere around points, with its centre in the middle of their box."""
    for x in range(3):
        low, high = points[0, x], points[0, x]
        for k in range(1, len(points)):
            low, high = min(low, points[k, x]), max(high, points[k, x])
        sphere[x] = 0.5 * (low + high)
    most = 0.0
    for k in range(len(points)):
        dx, dy, dz = points[k, 0] - sphere[0], points[k, 1] - sphere[1], points[k, 2] - sphere[2]
        most = max(most, dx * dx + dy * dy + dz * dz)
    sphere[3] = math.sqrt(most) * RADIUS_ROUNDED_UP
