"""The winding number: how often a surface goes around a point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.geometry.mesh import TriangleMesh


def winding_number(mesh: TriangleMesh, point: NDArray[np.float64]) -> float:
    """0 outside a closed surface, 1 or -1 (by orientation) inside, in between for an open one.

    The sum of the triangles' signed solid angles over 4 pi, each by Van Oosterom and Strackee, "The solid angle of a
    plane triangle", IEEE Trans. Biomed. Eng. 30(2), 1983, Eq. 8.

    Args:
        mesh: The surface, mm.
        point: Shape (3,), mm, in the mesh's frame.
    """
    a, b, c = np.moveaxis(mesh.triangles - point, 1, 0)
    na, nb, nc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    denominator = na * nb * nc
    denominator += np.einsum("ij,ij->i", a, b) * nc
    denominator += np.einsum("ij,ij->i", b, c) * na
    denominator += np.einsum("ij,ij->i", c, a) * nb
    return float(2 * np.sum(np.arctan2(triple, denominator)) / (4 * np.pi))
