"""Is a point inside a surface? By the winding number, which also says when the question has no answer."""

from __future__ import annotations

from enum import Enum

import numpy as np

from planning.clearance.engine import Floats
from planning.mesh import TriangleMesh


class Side(Enum):
    """Where a point lies."""

    INSIDE = "inside"
    OUTSIDE = "outside"
    UNKNOWN = "unknown"


def side_of(mesh: TriangleMesh, point: Floats) -> Side:
    """Inside or outside of a closed surface, whatever its orientation; unknown for an open one."""
    if not mesh.closed:
        return Side.UNKNOWN
    return Side.INSIDE if abs(winding_number(mesh, point)) > 0.5 else Side.OUTSIDE


def winding_number(mesh: TriangleMesh, point: Floats) -> float:
    """How often the surface winds around a point: the signed solid angles of its triangles, over 4 pi.

    Each solid angle by Van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30, 1983, Eq. 8.
    """
    a, b, c = np.moveaxis(mesh.triangles - point, 1, 0)
    na, nb, nc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    denominator = na * nb * nc
    denominator += np.einsum("ij,ij->i", a, b) * nc
    denominator += np.einsum("ij,ij->i", b, c) * na
    denominator += np.einsum("ij,ij->i", c, a) * nb
    return float(2 * np.sum(np.arctan2(triple, denominator)) / (4 * np.pi))
