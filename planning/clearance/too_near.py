"""Whether axes come nearer to a structure than a limit; FCL decides what is a tie."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.clearance.engine import ClearanceEngine

NEAR_THRESHOLD_MM = 1e-4
"""Within this of a margin FCL's capsule collision decides: its own tolerance is 1e-6 mm."""

ROUNDING_MM = 1e-9
"""An axis that is too near by more than this is too close even where FCL does not see it: a capsule that overlaps a
triangle by less than 1e-6 mm is free to FCL."""


def too_near(
    engine: ClearanceEngine,
    structure: int,
    target_ct: Floats,
    outward_ct: Floats,
    length: float,
    distance: Floats,
    limit: float,
) -> NDArray[np.bool_]:
    """Whether axes come nearer to a structure's surface than a limit, shape (n,); FCL decides what is a tie.

    Args:
        engine: Which measured the distances.
        structure: Its place in the engine.
        target_ct: Shape (3,).
        outward_ct: Shape (n, 3), unit vectors.
        length: Of the axes, mm.
        distance: Shape (n,), of the axes from the surface, mm.
        limit: Needle radius plus margin, mm.
    """
    nearer = distance < limit
    for row in np.flatnonzero(np.abs(distance - limit) < NEAR_THRESHOLD_MM):
        nearer[row] = distance[row] < limit - ROUNDING_MM or engine.collides(
            structure, target_ct, outward_ct[row], length, limit
        )
    return nearer
