"""The skin as seen from one target: what a cone of directions needs to know of each of its triangles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planning.certify.cones import Zones, zones
from planning.mesh import TriangleMesh
from planning.skin import Skin

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

EDGE_ON = 1e-10
"""A triangle whose solid angle's determinant is below this, relative to its corners' lengths, is seen edge-on."""


@dataclass(frozen=True, eq=False)
class SkinSurface:
    """The m triangles of a skin, from the target.

    Attributes:
        corners: Shape (m, 3, 3), mm from the target.
        normals: Shape (m, 3, 3), unit normal at each corner: what `planning.skin_entry` blends.
        fold: Shape (m, 3), whether the number of crossings may change where a ray passes the edge from corner i to
            i + 1: it is not shared by exactly two triangles that lie on its two sides as seen from the target.
        cut: Shape (m,), triangles that are not skin.
        zones: The directions that meet each triangle.
        odd: Whether a ray crosses the surface an odd number of times; True for an open one, where it means nothing.
    """

    corners: Floats
    normals: Floats
    fold: Bools
    cut: Bools
    zones: Zones
    odd: bool


def skin_surface(skin: Skin, target_ct: Floats) -> SkinSurface:
    """Prepare a skin for one target."""
    corners = np.ascontiguousarray(skin.mesh.triangles - target_ct)
    odd = not skin.mesh.closed or _crosses_odd(corners)
    fold = _folds(skin.mesh, corners)
    return SkinSurface(corners, _corner_normals(skin.mesh), fold, skin.cut_faces, zones(corners, 0.0), odd)


def _corner_normals(mesh: TriangleMesh) -> Floats:
    """Area-weighted vertex normals, per corner, shape (m, 3, 3)."""
    corners = mesh.triangles
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    at_vertex = np.stack(
        [
            sum(np.bincount(mesh.faces[:, c], weights=areas[:, axis], minlength=len(mesh.vertices)) for c in range(3))
            for axis in range(3)
        ],
        axis=1,
    )
    lengths = np.linalg.norm(at_vertex, axis=1, keepdims=True)
    return np.ascontiguousarray((at_vertex / np.where(lengths > 0, lengths, 1.0))[mesh.faces])


def _folds(mesh: TriangleMesh, corners: Floats) -> Bools:
    """Edges (m, 3) past which the number of crossings may change."""
    _, welded = np.unique(mesh.vertices + 0.0, axis=0, return_inverse=True)
    faces = welded.reshape(-1)[mesh.faces].astype(np.int64)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)
    proper = (ends[:, :, 0] != ends[:, :, 1]).all(axis=1)
    key = ends.min(axis=2) * (faces.max() + 1) + ends.max(axis=2)
    key[~proper] = -1
    side = _side(corners)[:, None] * np.where(ends[:, :, 0] < ends[:, :, 1], 1, -1)
    _, edge, count = np.unique(key.ravel(), return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    balance = np.bincount(edge, weights=side.ravel())
    seen = np.bincount(edge, weights=np.abs(side.ravel()))
    fold = ~((count == 2) & (balance == 0) & (seen == 2))[edge].reshape(key.shape)
    return fold & proper[:, None]


def _side(corners: Floats) -> NDArray[np.int64]:
    """Whether a triangle's corners turn to the left (1) or right (-1) as seen from the origin; 0 edge-on; (m,)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    determinant = np.einsum("ij,ij->i", a, np.cross(b, c))
    scale = np.prod(np.linalg.norm(corners, axis=2), axis=1)
    return np.where(np.abs(determinant) > EDGE_ON * scale, np.sign(determinant), 0).astype(np.int64)


def _crosses_odd(corners: Floats) -> bool:
    """Parity of a ray's crossings: for a closed surface it is the same for all rays that meet no edge."""
    ray = np.array([0.42426406871192845, 0.7071067811865476, 0.565685424949238])  # along no axis and no diagonal
    a, b, c = np.moveaxis(corners, 1, 0)
    weights = np.stack([np.cross(b, c) @ ray, np.cross(c, a) @ ray, np.cross(a, b) @ ray])
    hit = (weights > 0).all(axis=0) | (weights < 0).all(axis=0)
    total = weights.sum(axis=0)
    depth = np.einsum("ki,ikj,j->i", weights, corners, ray)
    return bool(np.count_nonzero(hit & (depth * total > 0)) % 2)
