"""Whether a surface hides its own back from whoever is outside of it."""

# numba infers the types
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.mesh import TriangleMesh


def faces_outwards(mesh: TriangleMesh) -> bool:
    """Whether a surface is closed, and every triangle that faces away from an eye outside of it is behind another.

    No where it has a hollow, which is wound like a piece that is inside out.
    """
    return mesh.closed and mesh.wound_alike and bool(_every_piece_holds_volume(mesh.vertices, mesh.faces))


@nb.njit(cache=True, error_model="numpy")
def _every_piece_holds_volume(vertices, faces):
    """Whether triangles that hang together by their corners enclose more than nothing, seen from their outside.

    Where a surface repeats corners, its pieces may be open, and what they enclose is measured from its first corner:
    of those of a closed surface that is inside out at least one holds less than nothing.

    Args:
        vertices: Shape (n, 3), mm, read-only.
        faces: Shape (m, 3), read-only.
    """
    piece = np.arange(len(vertices))  # of each corner another one of the same piece, of one corner itself
    for f in range(len(faces)):
        a = _first_of(piece, faces[f, 0])
        for k in range(1, 3):
            b = _first_of(piece, faces[f, k])
            a, b = min(a, b), max(a, b)
            piece[b] = a
    volume = np.zeros(len(vertices))
    for f in range(len(faces)):
        ax, ay, az = _from_first(vertices, faces[f, 0])
        bx, by, bz = _from_first(vertices, faces[f, 1])
        cx, cy, cz = _from_first(vertices, faces[f, 2])
        holds = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        volume[_first_of(piece, faces[f, 0])] += holds
    least = np.inf
    for f in range(len(faces)):
        least = min(least, volume[_first_of(piece, faces[f, 0])])
    return least > 0.0


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _first_of(piece, corner):
    while piece[corner] != corner:
        piece[corner] = piece[piece[corner]]  # halves the way for whoever comes next
        corner = piece[corner]
    return corner


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _from_first(vertices, corner):
    return (
        vertices[corner, 0] - vertices[0, 0],
        vertices[corner, 1] - vertices[0, 1],
        vertices[corner, 2] - vertices[0, 2],
    )
