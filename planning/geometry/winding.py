"""How far a surface goes around a point: the winding number, and by rays, which do not ask how triangles are wound."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.crossings import crossings
from puncture_twin.planning.geometry.mesh import TriangleMesh

RAYS = 1000
"""A fraction of all directions is found to about a percent."""


def winding_number(mesh: TriangleMesh, point: NDArray[np.float64]) -> float:
    """0 outside a closed surface, 1 or -1 (by orientation) inside, in between for an open one.

    The sum of the triangles' signed solid angles over 4 pi, each by Van Oosterom and Strackee, "The solid angle of a
    plane triangle", IEEE Trans. Biomed. Eng. 30(2), 1983, Eq. 8.

    Args:
        mesh: The surface, mm.
        point: Shape (3,), mm, in the mesh's frame.
    """
    return float(winding_numbers(mesh, point[None])[0])


def winding_numbers(mesh: TriangleMesh, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """`winding_number` of many points (n, 3), mm: shape (n,)."""
    found = np.empty(len(points))
    _solid_angles(mesh.vertices, mesh.faces, np.array(points, dtype=np.float64, order="C"), found)
    return found / (4 * np.pi)


@nb.njit(cache=True, error_model="numpy")
def _solid_angles(vertices, faces, points, found):  # type: ignore[no-untyped-def]  # numba infers
    """The sum over all triangles (m, 3) of vertices (n, 3), as in `winding_number`, of each point."""
    for row in range(len(points)):
        x, y, z = points[row]
        total = 0.0
        for face in faces:
            a, b, c = vertices[face[0]], vertices[face[1]], vertices[face[2]]
            ax, ay, az = a[0] - x, a[1] - y, a[2] - z
            bx, by, bz = b[0] - x, b[1] - y, b[2] - z
            cx, cy, cz = c[0] - x, c[1] - y, c[2] - z
            na, nb_ = np.sqrt(ax * ax + ay * ay + az * az), np.sqrt(bx * bx + by * by + bz * bz)
            nc = np.sqrt(cx * cx + cy * cy + cz * cz)
            triple = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
            below = na * nb_ * nc + (ax * bx + ay * by + az * bz) * nc
            below += (bx * cx + by * cy + bz * cz) * na + (cx * ax + cy * ay + cz * az) * nb_
            total += 2.0 * np.arctan2(triple, below)
        found[row] = total


def odd_fraction(mesh: TriangleMesh, point: NDArray[np.float64]) -> float:
    """Of all directions from a point, the part in which a ray crosses the surface an odd number of times.

    0 outside of a closed surface, 1 inside, in between for an open one; a triangle that is given twice counts once.

    Args:
        mesh: The surface, mm.
        point: Shape (3,), mm, in the mesh's frame.
    """
    surface = TriangleMesh(mesh.vertices, mesh.faces[mesh.distinct])
    return float(np.mean(crossings(surface, point, _rays()).count % 2))


def hit_fraction(mesh: TriangleMesh, point: NDArray[np.float64]) -> float:
    """Of all directions from a point, the part in which a ray meets the surface at all.

    1 inside a closed surface, and also in a hollow of it, of which `winding_number` is 0.

    Args:
        mesh: The surface, mm.
        point: Shape (3,), mm, in the mesh's frame.
    """
    return float(np.mean(crossings(mesh, point, _rays()).count > 0))


def _rays() -> NDArray[np.float64]:
    """Unit vectors, shape (RAYS, 3), evenly about: a spiral of equal steps in z and golden turns."""
    z = 1.0 - (2.0 * np.arange(RAYS) + 1.0) / RAYS
    turn, ring = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(RAYS), np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
