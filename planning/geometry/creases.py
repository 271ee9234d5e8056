"""Vertex normals that are smooth where a surface is smooth and separate where it has a crease."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh

CREASE = np.radians(60.0)
"""Two triangles at a larger angle are faces of a thing with an edge. Steps of a meshed voxel mask stay below (55)."""

COHERENT = 0.5
"""Fraction of the areas about a corner that their sum keeps at least, where they are one side of a smooth surface. Of
triangles given both ways round, or wound against each other, it keeps less: their blend is no normal."""


def split_at_creases(mesh: TriangleMesh) -> TriangleMesh:
    """A surface with one vertex for each smooth fan of triangles about a point.

    A normal that is blended from the triangles of a vertex then never mixes two sides of a box, and mixes the
    triangles of a smooth surface even where the file stores each with corners of its own (as STL does). The order of
    the triangles is kept.
    """
    keys = (mesh.vertices + 0.0).view(np.dtype((np.void, 24))).reshape(-1)
    _, welded = np.unique(keys, return_inverse=True)
    corner_vertex = welded[mesh.faces]
    pairs = _smooth_pairs(mesh, corner_vertex.astype(np.int64))
    count = 3 * len(mesh.faces)
    graph = scipy.sparse.coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    fans, fan = scipy.sparse.csgraph.connected_components(graph, directed=False)
    vertices = np.empty((fans, 3))
    vertices[fan] = mesh.vertices[mesh.faces.reshape(-1)]
    return TriangleMesh(vertices, fan.reshape(-1, 3))


def _smooth_pairs(mesh: TriangleMesh, corner_vertex: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs of triangle corners (3 f + k) at one point, of two triangles that share an edge smoothly."""
    faces = np.repeat(np.arange(len(mesh.faces)), 3)
    first, second = corner_vertex.reshape(-1), np.roll(corner_vertex, -1, axis=1).reshape(-1)
    this, following = np.arange(3 * len(mesh.faces)), 3 * faces + (np.tile([1, 2, 0], len(mesh.faces)))
    swap = first > second
    low_corner, high_corner = np.where(swap, following, this), np.where(swap, this, following)
    edge = np.minimum(first, second) * (corner_vertex.max() + 1) + np.maximum(first, second)
    order = np.argsort(edge, kind="stable")
    same = np.flatnonzero(edge[order][1:] == edge[order][:-1])
    a, b = order[same], order[same + 1]
    normals = _normals(mesh)
    along = np.where(swap[a] == swap[b], -1.0, 1.0)  # of neighbours wound alike one runs the edge back
    smooth = along * np.einsum("ij,ij->i", normals[faces[a]], normals[faces[b]]) >= np.cos(CREASE)
    a, b = a[smooth], b[smooth]
    return np.concatenate(
        [np.stack([low_corner[a], low_corner[b]], axis=1), np.stack([high_corner[a], high_corner[b]], axis=1)]
    )


def _normals(mesh: TriangleMesh) -> NDArray[np.float64]:
    corners = mesh.triangles
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(areas, axis=1, keepdims=True)
    return np.asarray(areas / np.where(lengths > 0, lengths, 1.0))


def smooth_normals(mesh: TriangleMesh, face: NDArray[np.int64], points: Floats) -> Floats:
    """Unit normals at points of triangles: the corners' normals (area weighted), blended; shape (n, 3).

    The triangle's own where those about one of its corners have no common side.
    """
    marked = np.zeros(len(mesh.vertices), bool)
    marked[mesh.faces[face]] = True
    around = np.flatnonzero(marked[mesh.faces].any(axis=1))
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[around]], 1, 0)
    areas = np.cross(b - a, c - a)
    corners, at_vertex = mesh.faces[around].T.reshape(-1), np.empty_like(mesh.vertices)

    def about_vertices(part: Floats) -> Floats:
        return np.asarray(np.bincount(corners, weights=np.tile(part, 3), minlength=len(at_vertex)))

    for axis, part in enumerate(areas.T):
        at_vertex[:, axis] = about_vertices(part)
    kept, whole = np.linalg.norm(at_vertex, axis=1), about_vertices(np.linalg.norm(areas, axis=1))
    crossed = TriangleMesh(mesh.vertices, mesh.faces[face])
    weights, own = _corner_weights(crossed.triangles, points), _normals(crossed)
    normals = _unit(at_vertex)[mesh.faces[face]]
    signs = np.where(np.einsum("ijk,ik->ij", normals, own) < 0.0, -1.0, 1.0)
    blended = _unit(np.einsum("ij,ij,ijk->ik", weights, signs, normals))
    coherent = (kept >= COHERENT * whole)[mesh.faces[face]].all(axis=1)
    return np.where(coherent[:, None], blended, own)


def _corner_weights(triangles: Floats, points: Floats) -> Floats:
    """How much corners count (n, 3) at points of triangles (n, 3, 3): as the areas opposite, in one measure per row."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    parts = [np.cross(c - b, points - b), np.cross(a - c, points - c), np.cross(b - a, points - a)]
    return np.stack([np.einsum("ij,ij->i", part, normal) for part in parts], axis=1)


def _unit(vectors: Floats) -> Floats:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)
