"""What a mesh leaves open: triangles without area, an open surface, inverted normals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from puncture_twin.planning.base.cache.array_cache import Arrays, Cache
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
        warnings.append(f"{name}: triangles are given twice or wound against their neighbours: inside is found by rays")
    elif mesh.volume < 0.0:
        warnings.append(f"{name}: inverted normals: they point inward (was it mirrored?); inside is found without them")
    return tuple(warnings)


def kept_mesh_warnings(meshes: Mapping[str, TriangleMesh], cache: Cache) -> tuple[str, ...]:
    """As `mesh_warnings` of each mesh, by name; what was found of the same meshes before is not found again.

    The meshes know then whether they are closed and wound alike, see `TriangleMesh.known`.
    """
    made_from = {"what": "mesh warnings", "meshes": [(name, mesh.digest) for name, mesh in meshes.items()]}

    def found() -> Arrays:
        lines = [line for name, mesh in meshes.items() for line in mesh_warnings(mesh, name)]
        facts = [(mesh.closed, mesh.wound_alike) for mesh in meshes.values()]
        return {"lines": np.array(lines, np.str_), "facts": np.array(facts, np.bool_).reshape(-1, 2)}

    def check(kept: Arrays) -> None:
        lines, facts = kept["lines"], kept["facts"]
        if lines.dtype.kind != "U" or lines.ndim != 1 or facts.dtype != np.bool_ or facts.shape != (len(meshes), 2):
            raise ValueError("no lines, or not of these meshes")

    kept = cache.arrays(made_from, found, by=__name__, check=check)
    for mesh, (closed, wound_alike) in zip(meshes.values(), kept["facts"].tolist(), strict=True):
        mesh.known(closed=closed, wound_alike=wound_alike)
    return tuple(kept["lines"].tolist())
