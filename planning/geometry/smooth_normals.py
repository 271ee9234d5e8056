"""Normals of a surface at points of its triangles, blended from those of their corners."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh


def smooth_normals(mesh: TriangleMesh, face: NDArray[np.int64], points: Floats) -> Floats:
    """Unit normals at points of triangles: the corners' normals (area weighted), blended; shape (n, 3)."""
    a, b, c = np.moveaxis(mesh.triangles, 1, 0)
    areas = np.cross(b - a, c - a)
    at_vertex = np.zeros_like(mesh.vertices)
    for corner in mesh.faces.T:
        np.add.at(at_vertex, corner, areas)
    weights = _corner_weights(mesh.triangles[face], points)
    return _unit(np.einsum("ij,ijk->ik", weights, _unit(at_vertex)[mesh.faces[face]]))


def _corner_weights(triangles: Floats, points: Floats) -> Floats:
    """How much corners count (n, 3) at points of triangles (n, 3, 3): as the areas opposite, in one measure per row."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    parts = [np.cross(c - b, points - b), np.cross(a - c, points - c), np.cross(b - a, points - a)]
    return np.stack([np.einsum("ij,ij->i", part, normal) for part in parts], axis=1)


def _unit(vectors: Floats) -> Floats:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)
