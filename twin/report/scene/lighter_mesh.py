"""A mesh with fewer triangles, for a browser; pictures only."""

from __future__ import annotations

from hashlib import sha256

import fast_simplification
import numpy as np

from puncture_twin.planning.base.cache.array_cache import Arrays, Cache
from puncture_twin.planning.geometry.mesh import TriangleMesh

WELDED = 0.75
"""Corners per triangle; a closed surface that shares its corners has half a corner per triangle."""


def lighter_mesh(mesh: TriangleMesh, triangles: int, cache: Cache) -> TriangleMesh:
    """The mesh with about so many triangles; itself where it has no more, or where nothing would be left.

    Args:
        mesh: Any surface, mm.
        triangles: How many are wanted.
        cache: Where lightened meshes are kept.
    """
    if triangles >= len(mesh.faces):
        return mesh
    made_from = {
        "what": "lighter mesh",
        "vertices": sha256(mesh.vertices.tobytes()).hexdigest(),
        "faces": sha256(mesh.faces.tobytes()).hexdigest(),
        "triangles": triangles,
    }
    found = cache.arrays(made_from, lambda: _simplified(mesh, triangles), by=__name__, check=_check)
    if len(found["faces"]) == 0:  # nothing may vanish from a picture
        return mesh
    return TriangleMesh(found["vertices"], found["faces"])


def _check(stored: Arrays) -> None:
    vertices, faces = stored["vertices"], stored["faces"]
    if vertices.ndim != 2 or faces.ndim != 2 or {vertices.shape[1], faces.shape[1]} != {3}:
        raise ValueError("no mesh")
    if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError("an index out of range")


def _simplified(mesh: TriangleMesh, wanted: int) -> Arrays:
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if len(vertices) > WELDED * len(faces):  # a robot's STL shares no corners
        vertices, welded = np.unique(vertices, axis=0, return_inverse=True)
        faces = np.ascontiguousarray(welded.reshape(-1)[faces], dtype=np.int32)
    vertices, faces = fast_simplification.simplify(vertices, faces, target_count=wanted)
    return {"vertices": np.asarray(vertices, dtype=np.float64), "faces": np.asarray(faces, dtype=np.int32)}
