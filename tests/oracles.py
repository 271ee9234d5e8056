"""Slow, plain versions of what the planner computes: nothing here shares code with it."""

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


def segment_mesh_distance(p, q, mesh):
    """Distance of a segment from a surface: the least over its triangles."""
    return float(segment_triangle_distance(p, q, mesh.triangles).min())


def segment_triangle_distance(p, q, triangles):
    """Distance of a segment from triangles (..., 3, 3): crossing, edges against it, its ends against the face."""
    p, q, corners = np.asarray(p, float), np.asarray(q, float), np.moveaxis(np.asarray(triangles, float), -2, 0)
    edges = list(zip(corners, np.roll(corners, -1, axis=0), strict=True))
    found = [segment_segment_distance(p, q, *edge) for edge in edges]
    found += [point_triangle_distance(end, triangles) for end in (p, q)]
    n = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    above, below = _dot(p - corners[0], n), _dot(q - corners[0], n)
    passes = (_dot(n, n) > 0) & (above * below <= 0) & (above != below)
    x = p + (q - p) * (above / np.where(passes, above - below, 1.0))[..., None]
    return np.where(passes & _left_of_all(x, edges, n), 0.0, np.min(found, axis=0))


def segment_segment_distance(p, q, a, b):
    """Least distance of segments, (..., 3) each end: interior pair where there is one, else an end of either."""
    u, v, w = q - p, b - a, p - a
    found = [point_segment_distance(x, a, b) for x in (p, q)] + [point_segment_distance(x, p, q) for x in (a, b)]
    determinant, product = _dot(u, u) * _dot(v, v) - _dot(u, v) ** 2, _dot(u, u) * _dot(v, v)
    apart = np.where(determinant > 1e-14 * product, determinant, np.nan)
    s = (_dot(u, v) * _dot(v, w) - _dot(v, v) * _dot(u, w)) / apart
    t = (_dot(u, u) * _dot(v, w) - _dot(u, v) * _dot(u, w)) / apart
    inner = np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1)
    inside = (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    return np.minimum(np.min(found, axis=0), np.where(inside, inner, np.inf))


def point_segment_distance(x, a, b):
    """Distance of points from segments, (..., 3) each, which may be points."""
    x, a, b = (np.asarray(one, float) for one in (x, a, b))
    length = _dot(b - a, b - a)
    t = np.clip(_dot(x - a, b - a) / np.where(length > 0, length, 1.0), 0.0, 1.0)
    return np.linalg.norm(x - a - t[..., None] * (b - a), axis=-1)


def point_triangle_distance(x, triangles):
    """Distance of a point from triangles (..., 3, 3): its foot on the plane if inside, else the nearest edge."""
    x, corners = np.asarray(x, float), np.moveaxis(np.asarray(triangles, float), -2, 0)
    edges = list(zip(corners, np.roll(corners, -1, axis=0), strict=True))
    n = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    square, above = _dot(n, n), _dot(x - corners[0], n)
    flat = square > 0
    foot = x - n * (above / np.where(flat, square, 1.0))[..., None]
    away = np.where(flat & _left_of_all(foot, edges, n), np.abs(above) / np.sqrt(np.where(flat, square, 1.0)), np.inf)
    return np.minimum(np.min([point_segment_distance(x, *edge) for edge in edges], axis=0), away)


def _left_of_all(x, edges, n):
    return np.all([_dot(np.cross(end - start, x - start), n) >= 0 for start, end in edges], axis=0)


def _dot(a, b):
    return np.sum(a * b, axis=-1)


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
