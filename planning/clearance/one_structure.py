"""The distances of one structure from needle axes in many directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.clearance.direction_tiles import Tiles
from puncture_twin.planning.clearance.engine import AxisDistances
from puncture_twin.planning.clearance.kernels.blocks import Blocks
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.clearance.kernels.scratch import Found, scratch_for
from puncture_twin.planning.clearance.kernels.tile_search import search_tiles
from puncture_twin.planning.clearance.placed_surface import PlacedSurface


def measure_structure(
    target: Floats,
    tiles: Tiles,
    blocks: Blocks,
    placed: PlacedSurface,
    length: float,
    answer: AxisDistances,
    counts: NDArray[np.int64],
) -> None:
    """Fill one structure's distances from the axes of some directions.

    Args:
        target: Shape (3,), mm: where every axis starts.
        tiles: All or some of the n directions.
        blocks: The structure.
        placed: Itself as seen from the target.
        length: Of the axes, mm.
        answer: Arrays of shape (n,) in the caller's order; rows of ``tiles`` are filled.
        counts: Shape (7,), added to: see `tile_search.COUNTED`.
    """
    distance, depth, nearest = answer.distance, answer.depth, answer.nearest
    if placed.distance == 0.0:
        distance[tiles.order], depth[tiles.order], nearest[tiles.order] = 0.0, 0.0, placed.nearest
        return
    n = len(tiles.order)
    found = Found(np.empty(n), np.empty(n), np.empty(n, np.int64), counts)
    surface = (blocks.triangles, blocks.local, blocks.base)
    bundles = (tiles.outward, tiles.starts, tiles.middle, tiles.chord)
    search_tiles(
        surface, placed.nodes, placed.slack, target, float(length), placed.distance, placed.nearest,
        bundles, scratch_for(len(placed.nodes)), found, LANES,
    )  # fmt: skip
    distance[tiles.order], depth[tiles.order], nearest[tiles.order] = np.sqrt(found.square), found.depth, found.triangle
