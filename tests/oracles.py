"""Slow, plain versions of what the planner computes: nothing here shares code with it."""

import numpy as np


def segment_triangle_distance(p, q, triangle):
    """Distance of segment p-q from one triangle: crossing, edges against the segment, ends against the face."""
    a, b, c = triangle
    if _crosses(p, q, a, b, c):
        return 0.0
    found = [segment_segment_distance(p, q, *edge) for edge in ((a, b), (b, c), (c, a))]
    found += [point_triangle_distance(end, triangle) for end in (p, q)]
    return min(found)


def segment_segment_distance(p, q, a, b):
    """Least distance of two segments: interior pair where there is one, else an end of either."""
    u, v, w = q - p, b - a, p - a
    found = [point_segment_distance(x, a, b) for x in (p, q)] + [point_segment_distance(x, p, q) for x in (a, b)]
    determinant = (u @ u) * (v @ v) - (u @ v) ** 2
    if determinant > 1e-14 * (u @ u) * (v @ v):
        s = ((u @ v) * (v @ w) - (v @ v) * (u @ w)) / determinant
        t = ((u @ u) * (v @ w) - (u @ v) * (u @ w)) / determinant
        if 0 <= s <= 1 and 0 <= t <= 1:
            found.append(np.linalg.norm(w + s * u - t * v))
    return min(found)


def point_segment_distance(x, a, b):
    """Distance of a point from a segment, which may be a point."""
    length = (b - a) @ (b - a)
    t = 0.0 if length == 0 else np.clip((x - a) @ (b - a) / length, 0, 1)
    return np.linalg.norm(x - a - t * (b - a))


def point_triangle_distance(x, triangle):
    """Distance of a point from a triangle: its foot on the plane if inside, else the nearest edge."""
    a, b, c = triangle
    n = np.cross(b - a, c - a)
    found = [point_segment_distance(x, *edge) for edge in ((a, b), (b, c), (c, a))]
    if n @ n > 0:
        foot = x - n * ((x - a) @ n) / (n @ n)
        if all(np.cross(e1 - e0, foot - e0) @ n >= 0 for e0, e1 in ((a, b), (b, c), (c, a))):
            found.append(abs((x - a) @ n) / np.sqrt(n @ n))
    return min(found)


def _crosses(p, q, a, b, c):
    n = np.cross(b - a, c - a)
    above, below = (p - a) @ n, (q - a) @ n
    if n @ n == 0 or above * below > 0 or above == below:
        return False
    x = p + (q - p) * above / (above - below)
    return all(np.cross(e1 - e0, x - e0) @ n >= 0 for e0, e1 in ((a, b), (b, c), (c, a)))


def segment_mesh_distance(p, q, mesh):
    """Distance of a segment from a surface, triangle by triangle."""
    return min(segment_triangle_distance(p, q, triangle) for triangle in mesh.triangles)


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
