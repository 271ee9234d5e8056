"""The skin as compiled code takes it: its triangles in a balanced tree of boxes, and its field of distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Cache
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
    def of(cls, mesh: TriangleMesh) -> TriangleTree:
        """The tree of a mesh that has been checked: finite, not empty.

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
        lows, highs = [corners.min(axis=(1, 2))], [corners.max(axis=(1, 2))]
        for _ in range(levels):
            lows.insert(0, lows[0].reshape(-1, 2, 3).min(axis=1))
            highs.insert(0, highs[0].reshape(-1, 2, 3).max(axis=1))
        boxes = np.concatenate(lows), np.concatenate(highs)
        return cls(*boxes, np.ascontiguousarray(corners), order.astype(np.int32))


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
    made_from, (low, high) = {"what": "skin", "surface": patient.digest}, patient.bounds
    kept = cache.arrays(made_from, lambda: vars(TriangleTree.of(patient)), by=__name__)
    margin = FIELD_MARGIN_MM
    while np.prod(cells := np.ceil((high - low + 2.0 * margin) / CELL_MM).astype(np.int64)) > MOST_CELLS:
        margin = margin / 2.0 if margin > 1.0 else 0.0
        if margin == 0.0:
            cells = np.ones(3, np.int64)
            break
    tree, field = (kept["lows"], kept["highs"], kept["corners"]), np.full(cells, np.nan, np.float32)
    return SkinTree(tree, field, low - margin, kept["rows"] >= skin_triangles)
