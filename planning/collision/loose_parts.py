"""The connected parts of a surface, and whether one lies within a convex piece, where surfaces do not touch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.geometry.mesh import TriangleMesh


class LooseParts(NamedTuple):
    """The connected parts of a surface.

    Attributes:
        corners: Shape (k, 3), mm: a corner of each.
        sizes: Shape (k, 3), mm: the edges of the box about each.
    """

    corners: Floats
    sizes: Floats

    @classmethod
    def of(cls, mesh: TriangleMesh) -> LooseParts:
        """Of a mesh that has been checked."""
        points, begins = _in_parts(mesh)
        sizes = np.maximum.reduceat(points, begins) - np.minimum.reduceat(points, begins)
        return cls(points[begins], sizes)

    def no_larger_than(self, mm: float) -> LooseParts:
        """Those about which a box is not longer than that from corner to corner."""
        small = np.linalg.norm(self.sizes, axis=1) <= mm
        return LooseParts(self.corners[small], self.sizes[small])


def connected_parts(mesh: TriangleMesh) -> list[Floats]:
    """The corners of each connected part of a surface, shapes (n, 3)."""
    points, begins = _in_parts(mesh)
    return np.split(points, begins[1:])


def _in_parts(mesh: TriangleMesh) -> tuple[Floats, Ints]:
    """Corners part by part, and where each part begins; faces are connected where they share a corner."""
    count = len(mesh.vertices)
    used = np.flatnonzero(np.bincount(mesh.faces.ravel(), minlength=count))
    starts, ends = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    links = scipy.sparse.coo_array((np.ones(len(starts), np.int8), (starts, ends)), shape=(count, count))
    part = scipy.sparse.csgraph.connected_components(links, directed=False)[1][used]
    order = np.argsort(part, kind="stable")
    return mesh.vertices[used[order]], np.flatnonzero(np.diff(part[order], prepend=-1))


def half_spaces(corners: Floats) -> Floats:
    """The half spaces that a convex hull of corners (n, 3), mm, is the intersection of: shape (m, 4), outward."""
    return np.asarray(scipy.spatial.ConvexHull(corners).equations)


def within(points: Floats, pieces: Sequence[Floats]) -> Bools:
    """Which points (k, 3) lie within one of some convex pieces, each as of :func:`half_spaces`: shape (k,)."""
    inside = np.zeros(len(points), np.bool_)
    for planes in pieces:
        inside |= (points @ planes[:, :3].T + planes[:, 3] <= 0.0).all(axis=1)
    return inside
