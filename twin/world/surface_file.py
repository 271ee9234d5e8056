"""Surfaces as PyBullet reads them: OBJ files in metres."""

from __future__ import annotations

from pathlib import Path

from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.world.units import to_m


def write_obj(mesh: TriangleMesh, path: Path) -> None:
    """Write a surface, mm, as OBJ in metres, to a tenth of a micrometre."""
    corners = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in to_m(mesh.vertices).tolist()]
    faces = [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    path.write_text("\n".join(corners + faces) + "\n")
