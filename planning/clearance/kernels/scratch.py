"""The room in which one structure is searched: arrays made once, passed down as one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.clearance.kernels.nearest_triangle import STACK
from puncture_twin.planning.clearance.kernels.side_by_side import ROWS

NODE_ROWS = 10
"""Of a group of nodes, see `bounds.disc_bounds`."""

PAIRS = 64
"""Pairs of a direction and a block that are tested side by side."""

APART = 8
"""Columns by which rows of ``corners`` exceed a power of two, which would put them all in the same cache lines."""


class Scratch(NamedTuple):
    """Room for one bundle of at most 16 directions.

    Attributes:
        found: Shape (r,), the blocks that the bundle may have to look at.
        chosen: Shape (g, 10, 16), float32, their nodes side by side.
        bounds: Shape (16 g, 16), float32, their bounds: of member m and group j in row m g' + j, g' groups being used.
        stack: Shape (512, 2), groups of the tree that wait, and their level.
        frames: Shape (9, 16), each member's direction u, and e and f that complete it to a frame.
        frames32: The same as float32.
        upper: Shape (16,), float32, above each member's distance, mm.
        pairs: Shape (64, 2), members, and places in ``found``.
        squares: Shape (64, 16), float32, each pair's distances from its 16 triangles, mm^2.
        least: Shape (64,), float32, the least of them.
        errors: Shape (64,), float32, by how much such a distance may err, mm.
        tried: Shape (1024, 2), members, and rows of triangles.
        corners: Shape (12, 1032), see `side_by_side.measure_beside`.
    """

    found: NDArray[np.int64]
    chosen: NDArray[np.float32]
    bounds: NDArray[np.float32]
    stack: NDArray[np.int64]
    frames: NDArray[np.float64]
    frames32: NDArray[np.float32]
    upper: NDArray[np.float32]
    pairs: NDArray[np.int64]
    squares: NDArray[np.float32]
    least: NDArray[np.float32]
    errors: NDArray[np.float32]
    tried: NDArray[np.int64]
    corners: NDArray[np.float64]


class Found(NamedTuple):
    """What a search writes: squared distance (mm^2), depth (mm), nearest triangle of each axis; `COUNTED`."""

    square: NDArray[np.float64]
    depth: NDArray[np.float64]
    triangle: NDArray[np.int64]
    counts: NDArray[np.int64]


class NeedleAxes(NamedTuple):
    """Where all axes start and how long they are, and two float32 numbers.

    Attributes:
        target: Three numbers, mm.
        length: Shape (n,), of each axis, in the tiles' order, mm.
        longest: Of those of one bundle.
        slack: Rounding of a node's coordinate, mm.
    """

    target: Any
    length: Any
    longest: Any
    slack: Any


def scratch_for(groups: int) -> Scratch:
    """Room for bundles that may have to look at all of ``groups`` groups of blocks."""
    size = groups + 1
    return Scratch(
        found=np.empty(size * LANES, np.int64),
        chosen=np.empty((size, NODE_ROWS, LANES), np.float32),
        bounds=np.empty((size * LANES, LANES), np.float32),
        stack=np.empty((STACK, 2), np.int64),
        frames=np.empty((9, LANES)),
        frames32=np.empty((9, LANES), np.float32),
        upper=np.empty(LANES, np.float32),
        pairs=np.empty((PAIRS, 2), np.int64),
        squares=np.empty((PAIRS, LANES), np.float32),
        least=np.empty(PAIRS, np.float32),
        errors=np.empty(PAIRS, np.float32),
        tried=np.empty((PAIRS * LANES, 2), np.int64),
        corners=np.empty((ROWS, PAIRS * LANES + APART)),
    )
