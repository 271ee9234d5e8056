"""Distance of a needle from triangles, and the inside of a surface, the plain way: apart from the engine and from FCL.

Three precisions of one question: float64 for every triangle of every axis, long double for whatever is close, and both
from the definition: a segment meets a triangle in its face, or it is nearest at one of its ends or at an edge.
"""

from __future__ import annotations

from collections import Counter

import numba as nb
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.geometry.mesh import TriangleMesh

Floats = NDArray[np.float64]

ALONG = np.random.default_rng(20191104).normal(size=(5, 3))
"""Rays that vote on inside and outside. Their numbers stand in no simple ratio: a ray along (3, 1, 2) from a corner of
a voxel runs exactly through the edges of others, and counts wrongly."""

CLEARLY_MM = 1e-6
"""Far above the rounding of a ball's distance."""


@nb.njit(error_model="numpy")
def distances(p, q, triangles):  # type: ignore[no-untyped-def]  # numba infers
    """Distance of the segment p-q from each triangle, shape (m,), mm; ``triangles`` has shape (m, 3, 3)."""
    p, q = (p[0], p[1], p[2]), (q[0], q[1], q[2])
    found = np.empty(len(triangles))
    for k in range(len(triangles)):
        found[k] = _one_triangle(p, q, triangles[k])
    return found


@nb.njit(error_model="numpy")
def least_distances(p, ends, triangles):  # type: ignore[no-untyped-def]  # numba infers
    """Least distance from all triangles of the segments from p to each of ``ends``, shape (n,), mm.

    A triangle is passed over where its ball, about its corners' mean, lies clearly beyond what was found.
    """
    found, spheres = np.full(len(ends), np.inf), np.empty((len(triangles), 4))
    for k in range(len(triangles)):
        t = triangles[k]
        spheres[k, :3] = (t[0] + t[1] + t[2]) / 3.0
        for corner in range(3):
            away = _from_to(spheres[k], t[corner])
            spheres[k, 3] = max(spheres[k, 3] if corner > 0 else 0.0, np.sqrt(_dot(away, away)))
    start = (p[0], p[1], p[2])
    for row in range(len(ends)):
        end = (ends[row, 0], ends[row, 1], ends[row, 2])
        for k in range(len(triangles)):
            if np.sqrt(_from_segment(spheres[k], start, end)) - spheres[k, 3] <= found[row] + CLEARLY_MM:
                found[row] = min(found[row], _one_triangle(start, end, triangles[k]))
    return found


@nb.njit(error_model="numpy")
def _one_triangle(p, q, t):  # type: ignore[no-untyped-def]  # numba infers
    """Distance of the segment p-q from one triangle, shape (3, 3), mm."""
    a, b, c = (t[0, 0], t[0, 1], t[0, 2]), (t[1, 0], t[1, 1], t[1, 2]), (t[2, 0], t[2, 1], t[2, 2])
    if _through(p, q, a, b, c):
        return 0.0
    edges = min(_two_segments(p, q, a, b), _two_segments(p, q, b, c), _two_segments(p, q, c, a))
    return np.sqrt(min(edges, _from_face(p, a, b, c), _from_face(q, a, b, c)))


@nb.njit(error_model="numpy")
def _dot(x, y):  # type: ignore[no-untyped-def]  # numba infers
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


@nb.njit(error_model="numpy")
def _cross(x, y):  # type: ignore[no-untyped-def]  # numba infers
    return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


@nb.njit(error_model="numpy")
def _from_to(x, y):  # type: ignore[no-untyped-def]  # numba infers
    return y[0] - x[0], y[1] - x[1], y[2] - x[2]


@nb.njit(error_model="numpy")
def _onward(x, d, s):  # type: ignore[no-untyped-def]  # numba infers
    return x[0] + s * d[0], x[1] + s * d[1], x[2] + s * d[2]


@nb.njit(error_model="numpy")
def _over(x, a, b, c, n):  # type: ignore[no-untyped-def]  # numba infers
    """Whether a point projects into the triangle along its normal n."""
    if _dot(n, n) == 0.0 or _dot(_cross(_from_to(a, b), _from_to(a, x)), n) < 0.0:
        return False
    after_b = _dot(_cross(_from_to(b, c), _from_to(b, x)), n) >= 0.0
    return after_b and _dot(_cross(_from_to(c, a), _from_to(c, x)), n) >= 0.0


@nb.njit(error_model="numpy")
def _through(p, q, a, b, c):  # type: ignore[no-untyped-def]  # numba infers
    """Whether the segment passes through the face."""
    n = _cross(_from_to(a, b), _from_to(a, c))
    above, below = _dot(_from_to(a, p), n), _dot(_from_to(a, q), n)
    if above * below > 0.0 or above == below:
        return False
    return _over(_onward(p, _from_to(p, q), above / (above - below)), a, b, c, n)


@nb.njit(error_model="numpy")
def _from_face(x, a, b, c):  # type: ignore[no-untyped-def]  # numba infers
    """Squared height of a point over the face, infinite where it does not project into it."""
    n = _cross(_from_to(a, b), _from_to(a, c))
    return _dot(_from_to(a, x), n) ** 2 / _dot(n, n) if _over(x, a, b, c, n) else np.inf


@nb.njit(error_model="numpy")
def _from_segment(x, a, b):  # type: ignore[no-untyped-def]  # numba infers
    """Squared distance of a point from a segment, which may be a point."""
    d, e = _from_to(a, b), _from_to(a, x)
    size = _dot(d, d)
    share = 0.0 if size == 0.0 else min(max(_dot(e, d) / size, 0.0), 1.0)
    gap = _onward(e, d, -share)
    return _dot(gap, gap)


@nb.njit(error_model="numpy")
def _two_segments(p, q, a, b):  # type: ignore[no-untyped-def]  # numba infers
    """Squared distance of two segments: from an end of either, or between two inner points."""
    ends = min(_from_segment(p, a, b), _from_segment(q, a, b), _from_segment(a, p, q), _from_segment(b, p, q))
    u, v, w = _from_to(p, q), _from_to(a, b), _from_to(p, a)
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    size = uu * vv - uv * uv
    if size <= 0.0:
        return ends
    s, t = (_dot(u, w) * vv - _dot(v, w) * uv) / size, (_dot(u, w) * uv - _dot(v, w) * uu) / size
    if not (0.0 <= s <= 1.0 and 0.0 <= t <= 1.0):
        return ends
    gap = _onward(_onward(w, v, t), u, -s)
    return min(ends, _dot(gap, gap))


def exact_distance(target: Floats, outward: Floats, length: float, triangles: Floats) -> float:
    """Least distance of one axis from triangles (m, 3, 3) in long double (64 bits of mantissa), mm."""
    p = target.astype(np.longdouble)
    q = p + np.longdouble(length) * outward.astype(np.longdouble)
    a, b, c = np.moveaxis(triangles.astype(np.longdouble), 1, 0)
    n = np.cross(b - a, c - a)
    above, below = _rows(p - a, n), _rows(q - a, n)
    share = np.where(above == below, 2, above / np.where(above == below, 1, above - below))
    crossed = (share >= 0) & (share <= 1) & _over_rows(p + share[:, None] * (q - p), a, b, c, n)
    if crossed.any():
        return 0.0
    least = [_two_segments_rows(p, q, *edge) for edge in ((a, b), (b, c), (c, a))]
    for end in (p, q):
        height = _rows(end - a, n) ** 2 / np.where(_rows(n, n) == 0, 1, _rows(n, n))
        least.append(np.where(_over_rows(end, a, b, c, n), height, np.inf))
    return float(np.sqrt(np.min(least)))


def _rows(x: NDArray[np.longdouble], y: NDArray[np.longdouble]) -> NDArray[np.longdouble]:
    return (x * y).sum(axis=-1)


def _over_rows(x, a, b, c, n):  # type: ignore[no-untyped-def]  # long doubles of shape (3,) or (m, 3)
    sides = [_rows(np.cross(e - s, x - s), n) >= 0 for s, e in ((a, b), (b, c), (c, a))]
    return sides[0] & sides[1] & sides[2] & (_rows(n, n) > 0)


def _from_segment_rows(x, a, b):  # type: ignore[no-untyped-def]  # as above
    d, size = b - a, _rows(b - a, b - a)
    share = np.clip(_rows(x - a, d) / np.where(size == 0, 1, size), 0, 1)
    gap = x - a - share[..., None] * d
    return _rows(gap, gap)


def _two_segments_rows(p, q, a, b):  # type: ignore[no-untyped-def]  # as above
    ends = [_from_segment_rows(x, a, b) for x in (p, q)] + [_from_segment_rows(x, p, q) for x in (a, b)]
    u, v, w = q - p, b - a, a - p
    uu, uv, vv, uw, vw = _rows(u, u), _rows(u, v), _rows(v, v), _rows(u, w), _rows(v, w)
    size = uu * vv - uv * uv
    safe = np.where(size > 0, size, 1)
    s, t = (uw * vv - vw * uv) / safe, (uw * uv - vw * uu) / safe
    gap = w + v * t[:, None] - u * s[:, None]
    inner = (size > 0) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    return np.min([*ends, np.where(inner, _rows(gap, gap), np.inf)], axis=0)


class Inside:
    """Whether points are inside a surface, by rays: nothing of the winding number's arithmetic.

    A surface has an inside where every edge has an even number of distinct triangles. Where neighbours run their common
    edges in opposite senses, what is wound about at all is inside (shells within shells); where they do not, a point is
    inside if a ray leaves it through an odd number of distinct triangles.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        keys = {key: number for number, key in enumerate(dict.fromkeys(map(tuple, (mesh.vertices + 0.0).tolist())))}
        welded = [tuple(keys[tuple(corner)] for corner in triangle) for triangle in (mesh.triangles + 0.0).tolist()]
        proper = [row for row, (a, b, c) in enumerate(welded) if len({a, b, c}) == 3]
        distinct = {tuple(sorted(welded[row])): row for row in reversed(proper)}
        sides = Counter(edge for t in distinct for edge in ((t[0], t[1]), (t[1], t[2]), (t[0], t[2])))
        self.closed = bool(sides) and all(count % 2 == 0 for count in sides.values())
        runs = Counter((welded[row][i], welded[row][(i + 1) % 3]) for row in proper for i in range(3))
        self._oriented = all(runs[b, a] == count for (a, b), count in runs.items())
        self._triangles = mesh.triangles[proper if self._oriented else sorted(distinct.values())]

    def holds(self, point: Floats) -> bool:
        """The vote of five rays; False for a surface without an inside."""
        if not self.closed:
            return False
        sums, counts = np.array([_passed(point, ray, self._triangles) for ray in ALONG]).T
        votes = sums != 0 if self._oriented else counts % 2 == 1
        return 2 * int(votes.sum()) > len(ALONG)


@nb.njit(error_model="numpy")
def _passed(point, ray, triangles):  # type: ignore[no-untyped-def]  # numba infers
    """Faces that a ray passes: leaving less entering, and all."""
    total, count = 0, 0
    for k in range(len(triangles)):
        a, b, c = _from_to(point, triangles[k, 0]), _from_to(point, triangles[k, 1]), _from_to(point, triangles[k, 2])
        one, two, three = _dot(ray, _cross(a, b)), _dot(ray, _cross(b, c)), _dot(ray, _cross(c, a))
        leaves, enters = one > 0 and two > 0 and three > 0, one < 0 and two < 0 and three < 0
        ahead = one * _dot(ray, c) + two * _dot(ray, a) + three * _dot(ray, b)
        if (leaves and ahead > 0) or (enters and ahead < 0):
            total += 1 if leaves else -1
            count += 1
    return total, count
