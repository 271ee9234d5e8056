"""What a mesh leaves open: triangles without area, an open surface, inverted normals."""

from __future__ import annotations

from functools import partial

import numpy as np

from puncture_twin.planning.base.cache.memory import NO_MEMORY, Memory
from puncture_twin.planning.formats.mesh_guard import twice_areas
from puncture_twin.planning.geometry.mesh import TriangleMesh


def mesh_warnings(mesh: TriangleMesh, name: str) -> tuple[str, ...]:
    """What can no longer be known about a structure, or looks unusual, one sentence each.

    Args:
        mesh: The structure's surface, mm.
        name: Its name, for the text.
    """
    warnings = []
    flat = int((twice_areas(mesh.vertices, mesh.faces) == 0.0).sum())
    if flat:
        warnings.append(f"{name}: {flat} of {len(mesh.faces)} triangles have no area (kept)")
    if not mesh.closed:
        warnings.append(
            f"{name}: open mesh: inside or outside cannot be known, only the distance to its surface; "
            "if it should be closed, the file may be incomplete"
        )
    elif not mesh.wound_alike:
        warnings.append(f"{name}: triangles are wound against their neighbours: inside is found by rays")
    elif _signed_volume(mesh) < 0.0:
        warnings.append(f"{name}: inverted normals: they point inward; inside is found without them")
    return tuple(warnings)


def kept_mesh_warnings(mesh: TriangleMesh, name: str, memory: Memory) -> tuple[str, ...]:
    """As `mesh_warnings`; what this process keeps of the same mesh is not found again."""
    if memory is NO_MEMORY:
        return mesh_warnings(mesh, name)
    key = (mesh_warnings.__name__, mesh.digest, name)
    return memory.get(key, partial(mesh_warnings, mesh, name), lambda lines: sum(map(len, lines)))


def _signed_volume(mesh: TriangleMesh) -> float:
    """Volume by the divergence theorem, mm^3; negative when the triangles face inward."""
    a, b, c = np.moveaxis(mesh.triangles - mesh.vertices[0], 1, 0)
    return float(np.einsum("ij,ij", a, np.cross(b, c)) / 6.0)
