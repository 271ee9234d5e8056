"""Slow, plain versions of what the planner computes: nothing here shares code with it."""

import math
from types import SimpleNamespace

import numpy as np


class PlainEngine:
    """The distances of a clearance engine, triangle by triangle."""

    def __init__(self, meshes):
        self._meshes = meshes

    def measure(self, target_ct, outward_ct, length):
        """Shape (n, k)."""
        found = [
            [segment_mesh_distance(target_ct, target_ct + length * u, mesh) for mesh in self._meshes]
            for u in outward_ct
        ]
        return SimpleNamespace(distance=np.array(found))


def segment_triangle_distance(p, q, triangle):
    """Distance of segment p-q from one triangle: crossing, edges against the segment, ends against the face."""
    p, q, (a, b, c) = _floats(p), _floats(q), map(_floats, triangle)
    if _crosses(p, q, a, b, c):
        return 0.0
    found = [segment_segment_distance(p, q, *edge) for edge in ((a, b), (b, c), (c, a))]
    found += [point_triangle_distance(end, (a, b, c)) for end in (p, q)]
    return min(found)


def segment_segment_distance(p, q, a, b):
    """Least distance of two segments: interior pair where there is one, else an end of either."""
    u, v, w = _from(p, q), _from(a, b), _from(a, p)
    found = [point_segment_distance(x, a, b) for x in (p, q)] + [point_segment_distance(x, p, q) for x in (a, b)]
    determinant = _dot(u, u) * _dot(v, v) - _dot(u, v) ** 2
    if determinant > 1e-14 * _dot(u, u) * _dot(v, v):
        s = (_dot(u, v) * _dot(v, w) - _dot(v, v) * _dot(u, w)) / determinant
        t = (_dot(u, u) * _dot(v, w) - _dot(u, v) * _dot(u, w)) / determinant
        if 0 <= s <= 1 and 0 <= t <= 1:
            found.append(_length([w[k] + s * u[k] - t * v[k] for k in range(3)]))
    return min(found)


def point_segment_distance(x, a, b):
    """Distance of a point from a segment, which may be a point."""
    ab, ax = _from(a, b), _from(a, x)
    length = _dot(ab, ab)
    t = 0.0 if length == 0 else min(1.0, max(0.0, _dot(ax, ab) / length))
    return _length([ax[k] - t * ab[k] for k in range(3)])


def point_triangle_distance(x, triangle):
    """Distance of a point from a triangle: its foot on the plane if inside, else the nearest edge."""
    x, (a, b, c) = _floats(x), map(_floats, triangle)
    n = _cross(_from(a, b), _from(a, c))
    found = [point_segment_distance(x, *edge) for edge in ((a, b), (b, c), (c, a))]
    if _dot(n, n) > 0:
        above = _dot(_from(a, x), n)
        foot = [x[k] - n[k] * above / _dot(n, n) for k in range(3)]
        if _left_of_all_edges(foot, (a, b, c), n):
            found.append(abs(above) / math.sqrt(_dot(n, n)))
    return min(found)


def _crosses(p, q, a, b, c):
    n = _cross(_from(a, b), _from(a, c))
    above, below = _dot(_from(a, p), n), _dot(_from(a, q), n)
    if _dot(n, n) == 0 or above * below > 0 or above == below:
        return False
    x = [p[k] + (q[k] - p[k]) * above / (above - below) for k in range(3)]
    return _left_of_all_edges(x, (a, b, c), n)


def _left_of_all_edges(x, triangle, n):
    a, b, c = triangle
    return all(_dot(_cross(_from(e0, e1), _from(e0, x)), n) >= 0 for e0, e1 in ((a, b), (b, c), (c, a)))


# Vectors of three floats: for so few numbers plain Python is many times as fast as arrays.


def _floats(x):
    return x if isinstance(x, list) else [float(one) for one in x]


def _from(a, b):
    return [b[0] - a[0], b[1] - a[1], b[2] - a[2]]


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a, b):
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _length(a):
    return math.sqrt(_dot(a, a))


def segment_mesh_distance(p, q, mesh):
    """Distance of a segment from a surface, triangle by triangle."""
    p, q = _floats(p), _floats(q)
    return min(segment_triangle_distance(p, q, triangle) for triangle in mesh.triangles.tolist())


def ray_crossings(origin, direction, mesh):
    """Depths at which a ray crosses a surface (Möller-Trumbore, triangle by triangle), ascending."""
    depths = []
    for a, b, c in mesh.triangles:
        e1, e2 = b - a, c - a
        h = np.cross(direction, e2)
        determinant = e1 @ h
        if abs(determinant) < 1e-14:
            continue
        s = origin - a
        u = s @ h / determinant
        k = np.cross(s, e1)
        v = direction @ k / determinant
        t = e2 @ k / determinant
        if u >= 0 and v >= 0 and u + v <= 1 and t >= 0:
            depths.append(t)
    return sorted(depths)


def measure_displaced(engine, origins_ct, outward_ct, length):
    """Distances (n, k) of needles from (n, 3) along (n, 3), mm: the engine itself, asked of one after the other."""
    pairs = zip(origins_ct, outward_ct, strict=True)
    return np.array([engine.measure(origin, along[None], length).distance[0] for origin, along in pairs])


def units(rng, count):
    """Random directions, (count, 3)."""
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)
