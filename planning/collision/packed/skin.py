"""The skin as compiled code takes it: its triangles in a balanced tree of boxes, and its field of distances."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Arrays, Cache
from puncture_twin.planning.collision.kernels.proofs import SkinTree
from puncture_twin.planning.collision.kernels.surfaces import CELL_MM
from puncture_twin.planning.geometry.mesh import TriangleMesh

LEAF_TRIANGLES = 4
"""At most so many triangles in a leaf."""


@dataclass(frozen=True, eq=False)
class TriangleTree:
    """A heap of boxes: the children of node i are 2 i + 1 and 2 i + 2; the last level's nodes are the leaves.

    Attributes:
        lows: Shape (nodes, 3), mm: lowest corner of each node's box.
        highs: Shape (nodes, 3), mm.
        corners: Shape (leaves, k, 3, 3), mm: the triangles of each leaf; some stand in two, so that all have k.
        rows: Shape (leaves, k): which of the mesh's triangles they are.
    """

    lows: Floats
    highs: Floats
    corners: Floats
    rows: NDArray[np.int32]

    @classmethod
    def of(cls, mesh: TriangleMesh, cache: Cache = NO_CACHE) -> TriangleTree:
        """The tree of a mesh that has been checked: finite, not empty.

        Args:
            mesh: The surface.
            cache: Where its leaves are kept. What costs little to make from them is not: it is six times as large.
        """
        made_from = {"what": "leaves", "surface": mesh.digest}
        return cache.value(made_from, lambda: _leaves(mesh), partial(cls._of_leaves, mesh), by=__name__)

    @classmethod
    def _of_leaves(cls, mesh: TriangleMesh, leaves: Arrays) -> TriangleTree:
        """The tree from its leaves' boxes and rows.

        Raises:
            KeyError, TypeError, ValueError: They are not of this mesh.
        """
        rows = leaves["rows"]
        _check_leaves(mesh, leaves)
        lows, highs = [leaves["lows"]], [leaves["highs"]]
        while len(lows[0]) > 1:
            lows.insert(0, np.minimum(lows[0][::2], lows[0][1::2]))
            highs.insert(0, np.maximum(highs[0][::2], highs[0][1::2]))
        corners = mesh.vertices.take(mesh.faces.take(rows, axis=0).reshape(-1), axis=0).reshape(*rows.shape, 3, 3)
        arrays = np.concatenate(lows), np.concatenate(highs), corners
        for array in arrays:
            array.setflags(write=False)  # as all that comes from the cache: kernels are compiled for one kind
        return cls(*arrays, rows)


def _leaves(mesh: TriangleMesh) -> Arrays:
    """Which triangles share a leaf, and the leaves' boxes, as in `TriangleTree`.

    Each level halves every node's triangles at the median of their centres along its longest side.
    """
    triangles = mesh.triangles
    levels = max(0, int(np.ceil(np.log2(len(triangles) / LEAF_TRIANGLES))))
    size = -(-len(triangles) // 2**levels)
    order = np.minimum(np.arange(size * 2**levels), len(triangles) - 1)[None, :]
    centres = triangles.mean(axis=1)
    for _ in range(levels):
        inside = centres[order]
        axis = np.ptp(inside, axis=1).argmax(axis=1)
        keys = np.take_along_axis(inside, axis[:, None, None], axis=2)[:, :, 0]
        order = np.take_along_axis(order, np.argsort(keys, axis=1), axis=1).reshape(2 * len(order), -1)
    corners = triangles[order]
    return {"rows": order.astype(np.int32), "lows": corners.min(axis=(1, 2)), "highs": corners.max(axis=(1, 2))}


def _check_leaves(mesh: TriangleMesh, leaves: Arrays) -> None:
    """Refuse leaves that leave out a triangle, which an arm could touch then and nobody would know."""
    rows, boxes = leaves["rows"], (leaves["lows"], leaves["highs"])
    if rows.dtype != np.int32 or any(box.dtype != np.float64 or box.shape != (len(rows), 3) for box in boxes):
        raise TypeError("leaves of other types than ours")
    found = np.zeros(len(mesh.faces), np.bool_)
    if rows.ndim != 2 or len(rows).bit_count() != 1 or rows.min() < 0 or rows.max() >= len(found):
        raise ValueError("no leaves of this mesh")
    found[rows] = True
    if not found.all():
        raise ValueError("a triangle is in no leaf")


FIELD_MARGIN_MM = 500.0
"""How far around the skin distances are kept: beyond, they are seldom needed."""

MOST_CELLS = 4_000_000
"""Of that field (16 MB): a larger skin gets a narrower margin."""


def packed_skin(patient: TriangleMesh | None, skin_triangles: int, cache: Cache) -> SkinTree:
    """The skin's tree and its field, of which nothing is known yet; or some that no check wants.

    Args:
        patient: The skin, and behind it what the CT shows besides.
        skin_triangles: How many of the triangles are skin.
        cache: Where the tree is kept.
    """
    if patient is None:
        nothing = (np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 1, 3, 3)))
        return SkinTree(nothing, np.zeros((1, 1, 1), np.float32), np.zeros(3), np.zeros((1, 1), np.bool_))
    kept, (low, high) = TriangleTree.of(patient, cache), patient.bounds
    margin = FIELD_MARGIN_MM
    while np.prod(cells := np.ceil((high - low + 2.0 * margin) / CELL_MM).astype(np.int64)) > MOST_CELLS:
        margin = margin / 2.0 if margin > 1.0 else 0.0
        if margin == 0.0:
            cells = np.ones(3, np.int64)
            break
    tree, field = (kept.lows, kept.highs, kept.corners), np.full(cells, np.nan, np.float32)
    return SkinTree(tree, field, low - margin, kept.rows >= skin_triangles)
