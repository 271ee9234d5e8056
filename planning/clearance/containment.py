"""Is a point inside a surface? By the winding number, which also says when the question has no answer."""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray

from planning.mesh import TriangleMesh
from planning.winding import winding_number


class Side(Enum):
    """Where a point lies."""

    INSIDE = "inside"
    OUTSIDE = "outside"
    UNKNOWN = "unknown"


def side_of(mesh: TriangleMesh, point: NDArray[np.float64]) -> Side:
    """Inside or outside of a closed surface, whatever its orientation; unknown for an open one."""
    if not mesh.closed:
        return Side.UNKNOWN
    return Side.INSIDE if abs(winding_number(mesh, point)) > 0.5 else Side.OUTSIDE
