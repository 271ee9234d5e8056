"""Writes a mesh as a binary PLY."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.geometry.mesh import TriangleMesh


def ply_bytes(mesh: TriangleMesh) -> bytes:
    """A mesh as a little-endian binary PLY: float32 vertices, int32 faces."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, mesh.faces
    return header.encode("ascii") + mesh.vertices.astype("<f4").tobytes() + faces.tobytes()
