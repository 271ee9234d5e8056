"""The skin as seen from one target: the data of each triangle that bounds over cones of directions need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.certify.cones import Zones, zones

EDGE_ON = 1e-10
"""A triangle whose solid angle's determinant is below this, relative to its corners' lengths, is seen edge-on."""
RAYS, SEED = 5, 11
"""Directions that vote on parity, always the same: a regular direction hits the edges of surfaces made on a grid."""


@dataclass(frozen=True, eq=False)
class SkinSurface:
    """The m triangles of a skin, from the target."""

    corners: Floats
    """Shape (m, 3, 3), mm from the target."""
    normals: Floats
    """Shape (m, 3, 3), unit normal at each corner: what `puncture_twin.planning.anatomy.skin` blends."""
    fold: Bools
    """Shape (m, 3), whether the number of crossings may change where a ray passes the edge from corner i to i + 1: it
    is not shared by exactly two triangles that lie on its two sides as seen from the target."""
    cut: Bools
    """Shape (m,), triangles that are not skin."""
    zones: Zones
    """The directions that hit each triangle."""
    odd: bool
    """Whether a ray crosses the surface an odd number of times; True for an open one, where it means nothing."""


def skin_surface(skin: Skin, target_ct: Floats) -> SkinSurface:
    """Prepare a skin for one target."""
    corners = np.ascontiguousarray(skin.mesh.triangles - target_ct)
    mesh, rays = skin.mesh, np.random.default_rng(SEED).normal(size=(RAYS, 3))
    # one of some random rays may hit an edge: what most of them say counts
    odd = not mesh.closed or 2 * sum(bool(_crosses_odd(corners, ray)) for ray in rays) > RAYS
    normals = np.zeros((len(mesh.vertices), 3))  # weighted by area
    _add_normals(mesh.vertices, mesh.faces, normals)
    faces = welded(mesh.vertices)[mesh.faces]
    fold = np.empty(faces.shape, bool)
    _mark_folds(faces, _side(corners), len(mesh.vertices), fold)
    return SkinSurface(corners, normals[mesh.faces], fold, skin.cut_faces, zones(corners, 0.0), odd)


@nb.njit(cache=True)
def _add_normals(vertices, faces, normals):  # type: ignore[no-untyped-def]  # numba infers
    for i in range(len(faces)):
        a, b, c = vertices[faces[i, 0]], vertices[faces[i, 1]], vertices[faces[i, 2]]
        px, py, pz, qx, qy, qz = b[0] - a[0], b[1] - a[1], b[2] - a[2], c[0] - a[0], c[1] - a[1], c[2] - a[2]
        for k in range(3):
            normals[faces[i, k], 0] += py * qz - pz * qy
            normals[faces[i, k], 1] += pz * qx - px * qz
            normals[faces[i, k], 2] += px * qy - py * qx
    for i in range(len(normals)):
        length = np.sqrt(normals[i, 0] ** 2 + normals[i, 1] ** 2 + normals[i, 2] ** 2)
        if length > 0.0:
            for k in range(3):
                normals[i, k] /= length


def welded(vertices: Floats) -> NDArray[np.int64]:
    """Number of the place of each vertex, shape (n,): vertices at one place share it."""
    order = np.lexsort((vertices + 0.0).T)
    new = (np.diff(vertices[order], axis=0) != 0).any(axis=1)
    place = np.empty(len(vertices), np.int64)
    place[order] = np.concatenate([[0], np.cumsum(new)])
    return place


@nb.njit(cache=True)
def _mark_folds(faces, side, places, fold):  # type: ignore[no-untyped-def]  # numba infers
    """Each edge is looked for among those that leave the lower of its two ends."""
    start = np.zeros(places + 1, np.int64)
    for i in range(len(faces)):
        for k in range(3):
            start[min(faces[i, k], faces[i, (k + 1) % 3]) + 1] += 1
    start = np.cumsum(start)
    filled, edge = start[:-1].copy(), np.empty(3 * len(faces), np.int64)
    for i in range(len(faces)):
        for k in range(3):
            low = min(faces[i, k], faces[i, (k + 1) % 3])
            edge[filled[low]] = 3 * i + k
            filled[low] += 1
    for i in range(len(faces)):
        a, b, c = faces[i, 0], faces[i, 1], faces[i, 2]
        proper = a != b and b != c and c != a
        for k in range(3):
            p, q = faces[i, k], faces[i, (k + 1) % 3]
            low, high = min(p, q), max(p, q)
            count, balance, seen = 0, 0, 0
            for j in range(start[low], start[low + 1]):
                face, corner = edge[j] // 3, edge[j] % 3
                after = corner + 1 if corner < 2 else 0
                r, s = faces[face, corner], faces[face, after]
                other = faces[face, 3 - corner - after]
                if max(r, s) == high and r != s and s != other and other != r:
                    count += 1
                    balance += side[face] if r < s else -side[face]
                    seen += abs(side[face])
            fold[i, k] = proper and not (count == 2 and balance == 0 and seen == 2)


@nb.njit(cache=True)
def _side(corners):  # type: ignore[no-untyped-def]  # numba infers
    """Whether a triangle's corners turn to the left (1) or right (-1) as seen from the origin; 0 edge-on; (m,)."""
    side = np.zeros(len(corners), np.int64)
    for i in range(len(corners)):
        a, b, c = corners[i, 0], corners[i, 1], corners[i, 2]
        determinant = _triple(a, b, c)
        scale = np.sqrt(_square(a) * _square(b) * _square(c))
        if abs(determinant) > EDGE_ON * scale:
            side[i] = 1 if determinant > 0.0 else -1
    return side


@nb.njit(cache=True)
def _crosses_odd(corners, ray):  # type: ignore[no-untyped-def]  # numba infers
    """Parity of one ray's crossings; where it hits an edge, the edge's triangles are missed."""
    odd = False
    for i in range(len(corners)):
        a, b, c = corners[i, 0], corners[i, 1], corners[i, 2]
        wa, wb, wc = _triple(ray, b, c), _triple(ray, c, a), _triple(ray, a, b)
        if (wa > 0.0 and wb > 0.0 and wc > 0.0) or (wa < 0.0 and wb < 0.0 and wc < 0.0):
            ahead = 0.0
            for k in range(3):
                ahead += (wa * a[k] + wb * b[k] + wc * c[k]) * ray[k]
            odd ^= ahead * (wa + wb + wc) > 0.0
    return odd


@nb.njit(cache=True)
def _triple(u, p, q):  # type: ignore[no-untyped-def]  # numba infers
    return u[0] * (p[1] * q[2] - p[2] * q[1]) + u[1] * (p[2] * q[0] - p[0] * q[2]) + u[2] * (p[0] * q[1] - p[1] * q[0])


@nb.njit(cache=True)
def _square(a):  # type: ignore[no-untyped-def]  # numba infers
    return a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
