"""The skin's tree and its field of distances."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.collision.kernels.proofs import SkinTree
from puncture_twin.planning.collision.kernels.surfaces import CELL_MM
from puncture_twin.planning.collision.triangle_tree import TriangleTree
from puncture_twin.planning.geometry.mesh import TriangleMesh

FIELD_MARGIN_MM = 500.0
"""How far around the skin distances are kept: beyond, they are seldom needed."""

MOST_CELLS = 4_000_000
"""Of that field (16 MB): a larger skin gets a narrower margin."""


def packed_skin(patient: TriangleMesh | None, cache: Cache) -> SkinTree:
    """The skin's tree and its field, of which nothing is known yet; or some that no check wants."""
    if patient is None:
        nothing = (np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 1, 3, 3)))
        return SkinTree(nothing, np.zeros((1, 1, 1), np.float32), np.zeros(3))
    made_from, (low, high) = {"what": "skin", "surface": patient.digest}, patient.bounds
    kept = cache.arrays(made_from, lambda: vars(TriangleTree.of(patient)), by=__name__)
    margin = FIELD_MARGIN_MM
    while np.prod(cells := np.ceil((high - low + 2.0 * margin) / CELL_MM).astype(np.int64)) > MOST_CELLS:
        margin = margin / 2.0 if margin > 1.0 else 0.0
        if margin == 0.0:
            cells = np.ones(3, np.int64)
            break
    return SkinTree((kept["lows"], kept["highs"], kept["corners"]), np.full(cells, np.nan, np.float32), low - margin)
