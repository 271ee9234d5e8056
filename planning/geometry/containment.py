"""Is a point inside a surface? By the winding number, or by rays; and it is said when the question has no answer."""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.winding import winding_number, winding_numbers

RAYS, SEED = 5, 3
"""Random directions that vote, always the same: where one of them happens to meet an edge, the others do not."""


class Side(Enum):
    """Where a point lies."""

    INSIDE = "inside"
    OUTSIDE = "outside"
    UNKNOWN = "unknown"


def side_of(mesh: TriangleMesh, point: NDArray[np.float64]) -> Side:
    """Inside or outside of a closed surface, whatever its orientation; unknown for an open one.

    Where triangles are given twice or wound against their neighbours, the winding number means nothing: it may be 0
    deep inside. Then a point is inside if rays from it cross the surface an odd number of times.

    Args:
        mesh: The surface, mm.
        point: Shape (3,), mm, in the mesh's frame.
    """
    if not mesh.closed:
        return Side.UNKNOWN
    low, high = mesh.bounds
    if np.any(point < low) or np.any(point > high):
        return Side.OUTSIDE
    inside = round(winding_number(mesh, point)) != 0 if mesh.wound_alike else _leaves_oddly(mesh, point)
    return Side.INSIDE if inside else Side.OUTSIDE


def holds(mesh: TriangleMesh, point: NDArray[np.float64]) -> bool:
    """Whether a point (3,), mm, lies inside a closed surface, see :func:`side_of`; not if the surface is open.

    Most points lie outside of a surface's box: of these nobody needs to know whether it is closed.
    """
    low, high = mesh.bounds
    outside = bool(np.any(point < low) or np.any(point > high))
    return not outside and side_of(mesh, point) is Side.INSIDE


def inside_each(mesh: TriangleMesh, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of many points (n, 3) lie inside a closed surface, shape (n,); those on an open one are not told apart.

    Raises:
        ValueError: The surface is open.
    """
    if not mesh.closed:
        raise ValueError("an open surface has no inside")
    if not mesh.wound_alike:
        return np.array([_leaves_oddly(mesh, point) for point in points], dtype=bool)
    low, high = mesh.bounds
    inside = np.all((points > low) & (points < high), axis=1)
    rows = np.flatnonzero(inside)
    inside[rows] = np.round(winding_numbers(mesh, points[rows])) != 0
    return inside


def _leaves_oddly(mesh: TriangleMesh, point: NDArray[np.float64]) -> bool:
    """Whether most of the rays from a point cross an odd number of the surface's distinct triangles."""
    a, b, c = np.moveaxis(mesh.triangles[mesh.distinct] - point, 1, 0)
    rays = np.random.default_rng(SEED).normal(size=(3, RAYS))
    weights = np.stack([np.cross(b, c) @ rays, np.cross(c, a) @ rays, np.cross(a, b) @ rays])
    ahead = (weights * np.stack([a @ rays, b @ rays, c @ rays])).sum(axis=0) * weights.sum(axis=0) > 0
    around = np.abs(np.sign(weights).sum(axis=0)) == len(weights)
    odd = (around & ahead).sum(axis=0) % 2 == 1
    return bool(odd.mean() > 0.5)
