"""One surface as seen from one target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.clearance.kernels.blocks import Blocks
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.clearance.kernels.nearest_triangle import nearest_triangle

COORDINATE_SLACK = 1e-6
"""Share of a coordinate by which float32 arithmetic of a few terms may err: 8 times its rounding."""


@dataclass(frozen=True, eq=False)
class PlacedSurface:
    """One surface as seen from one target: the nodes of `bounds.disc_bounds`, and the target's own distance."""

    nodes: NDArray[np.float32]
    slack: float
    distance: float
    nearest: int


def placed_surface(blocks: Blocks, target: Floats) -> PlacedSurface:
    """A surface as seen from a target."""
    nodes = np.empty((10, len(blocks.center)), np.float32)
    nodes[:3] = (blocks.center - target).T
    nodes[3:8] = blocks.disc
    nodes[8] = np.hypot(nodes[6], nodes[7]) * np.float32(1 + 1e-6)
    away = np.sqrt(nodes[0] ** 2 + nodes[1] ** 2 + nodes[2] ** 2)
    nodes[9] = (away + nodes[8]) * np.float32(1 + 1e-6)
    slack = COORDINATE_SLACK * float(nodes[9][: len(blocks.local)].max())
    grouped = np.ascontiguousarray(nodes.reshape(10, -1, LANES).transpose(1, 0, 2))
    distance, nearest = nearest_triangle(blocks.triangles, grouped, blocks.base, target, slack)
    return PlacedSurface(grouped, slack, distance, nearest)
