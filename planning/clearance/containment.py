"""Is a point inside a surface? By the winding number, or by rays; and it is said when the question has no answer."""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray

from planning.mesh import TriangleMesh
from planning.winding import winding_number

RAYS = (
    (0.8018, 0.2673, 0.5345),
    (-0.3015, 0.9045, 0.3016),
    (0.1474, 0.4423, -0.8847),
    (-0.7071, -0.0513, -0.7053),
    (0.0917, -0.9811, 0.1704),
)
"""Directions along no axis and no diagonal: where one of them happens to meet an edge, the others do not."""


class Side(Enum):
    """Where a point lies."""

    INSIDE = "inside"
    OUTSIDE = "outside"
    UNKNOWN = "unknown"


def side_of(mesh: TriangleMesh, point: NDArray[np.float64]) -> Side:
    """Inside or outside of a closed surface, whatever its orientation; unknown for an open one.

    Where triangles are wound against their neighbours, the winding number means nothing: it may be 0 deep inside. Then
    a point is inside if rays from it cross the surface an odd number of times.

    Args:
        mesh: The surface, mm.
        point: Shape (3,), mm, in the mesh's frame.
    """
    if not mesh.closed:
        return Side.UNKNOWN
    low, high = mesh.bounds
    if not np.all((low <= point) & (point <= high)):
        return Side.OUTSIDE
    inside = abs(winding_number(mesh, point)) > 0.5 if mesh.wound_alike else _leaves_oddly(mesh, point)
    return Side.INSIDE if inside else Side.OUTSIDE


def _leaves_oddly(mesh: TriangleMesh, point: NDArray[np.float64]) -> bool:
    """Whether most of the rays from a point cross an odd number of the surface's distinct triangles."""
    a, b, c = np.moveaxis(mesh.triangles[mesh.distinct] - point, 1, 0)
    rays = np.array(RAYS).T
    wa, wb, wc = np.cross(b, c) @ rays, np.cross(c, a) @ rays, np.cross(a, b) @ rays
    ahead = wa * (a @ rays) + wb * (b @ rays) + wc * (c @ rays)
    leaves = (wa > 0) & (wb > 0) & (wc > 0) & (ahead > 0)
    enters = (wa < 0) & (wb < 0) & (wc < 0) & (ahead < 0)
    odd = (leaves | enters).sum(axis=0) % 2 == 1
    return bool(2 * odd.sum() > len(odd))
