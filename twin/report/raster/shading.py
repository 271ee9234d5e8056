"""The colour of what a sample shows: smooth normals, one lamp, and glass-like rims; compiled, sample by sample."""

# numba infers the types
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb

CREASE = 0.75
"""Cosine between a triangle's and its corner's normal below which the edge is drawn sharp."""

AMBIENT, DIFFUSE, SHINE = 0.38, 0.62, 0.18
"""Weights of Phong's terms; the highlight's exponent is 24."""

SMOOTH = 0.9
"""Cosine between the triangles that a pixel's samples show above which they are lit as one surface."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def corner_normals(vertices, faces):
    """Area-weighted unit normals at the vertices; zero where no triangle has an area.

    Args:
        vertices: Shape (n, 3).
        faces: Shape (m, 3).

    Returns:
        Shape (n, 3), float32.
    """
    sums = np.zeros((len(vertices), 3))
    for f in range(len(faces)):
        x, y, z = _normal(_row(vertices, faces[f, 0]), _row(vertices, faces[f, 1]), _row(vertices, faces[f, 2]))
        for i in range(3):
            sums[faces[f, i], 0] += x
            sums[faces[f, i], 1] += y
            sums[faces[f, i], 2] += z
    normals = np.empty((len(vertices), 3), dtype=np.float32)
    for i in range(len(vertices)):
        x, y, z = sums[i, 0], sums[i, 1], sums[i, 2]
        length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
        normals[i, 0], normals[i, 1], normals[i, 2] = x / length, y / length, z / length
    return normals


@nb.njit(cache=True, nogil=True, error_model="numpy")
def rotated(vectors, turn, shift):
    """Vectors (n, 3) in another frame, ``turn @ (vector - shift)``, of their own precision."""
    out = np.empty_like(vectors)
    for i in range(len(vectors)):
        x, y, z = vectors[i, 0] - shift[0], vectors[i, 1] - shift[1], vectors[i, 2] - shift[2]
        for k in range(3):
            out[i, k] = turn[k, 0] * x + turn[k, 1] * y + turn[k, 2] * z
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def flat_normals(points, faces):
    """Unit normals of the triangles, shape (m, 3), float32; zero where there is no area."""
    normals = np.empty((len(faces), 3), dtype=np.float32)
    for f in range(len(faces)):
        x, y, z = _normal(_row(points, faces[f, 0]), _row(points, faces[f, 1]), _row(points, faces[f, 2]))
        shrink = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-12)
        normals[f, 0], normals[f, 1], normals[f, 2] = x * shrink, y * shrink, z * shrink
    return normals


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def all_alike(triangle, top, bottom, left, right, bodies, flats):
    """Whether the samples of a pixel show one smooth surface, so that one shading serves them all."""
    f = triangle[top, left]
    if f < 0:
        return False
    for i in range(top, bottom):
        for j in range(left, right):
            g = triangle[i, j]
            if g == f:
                continue
            if g < 0 or bodies[g] != bodies[f]:
                return False
            if flats[f, 0] * flats[g, 0] + flats[f, 1] * flats[g, 1] + flats[f, 2] * flats[g, 2] < SMOOTH:
                return False
    return True


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _row(points, i):
    return points[i, 0], points[i, 1], points[i, 2]


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _normal(a, b, c):
    """(b - a) x (c - a)."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _triple(x, y, b, c):
    """(x, y, 1).(b x c)."""
    return x * (b[1] * c[2] - b[2] * c[1]) + y * (b[2] * c[0] - b[0] * c[2]) + (b[0] * c[1] - b[1] * c[0])


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def lit(points, normals, flats, faces, f, x, y, light):
    """Factor on the body's colour, grey of the highlight, |cos| between normal and ray.

    Phong's lighting (Commun. ACM 18, 1975) by one lamp beside the camera, with half Lambert: what faces away from the
    lamp keeps some shape instead of going flat.
    """
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    a, b, c = _row(points, i), _row(points, j), _row(points, k)
    p, q, r = _row(normals, i), _row(normals, j), _row(normals, k)
    wa, wb, wc = _triple(x, y, b, c), _triple(x, y, c, a), _triple(x, y, a, b)
    sx, sy, sz = wa * p[0] + wb * q[0] + wc * r[0], wa * p[1] + wb * q[1] + wc * r[1], wa * p[2] + wb * q[2] + wc * r[2]
    shrink = 1.0 / max(np.sqrt(sx * sx + sy * sy + sz * sz), 1e-12)
    sx, sy, sz = sx * shrink, sy * shrink, sz * shrink
    fx, fy, fz = _row(flats, f)
    cosine = sx * fx + sy * fy + sz * fz
    if abs(cosine) <= CREASE:
        sx, sy, sz = fx, fy, fz
    elif cosine < 0.0:
        sx, sy, sz = -sx, -sy, -sz
    if fx * x + fy * y + fz > 0.0:  # seen from behind
        sx, sy, sz = -sx, -sy, -sz
    along = 1.0 / np.sqrt(1 + x * x + y * y)
    facing = -(sx * x + sy * y + sz) * along
    toward = sx * light[0] + sy * light[1] + sz * light[2]
    half = 0.5 + 0.5 * toward
    mirrored = 2 * toward * facing + (light[0] * x + light[1] * y + light[2]) * along
    glint = min(max(mirrored, 0.0), 1.0)
    glint = glint * glint * glint
    glint = glint * glint
    glint = glint * glint
    glint = glint * glint
    return AMBIENT + DIFFUSE * half * half, 255 * SHINE * glint, min(max(facing, 0.0), 1.0)
