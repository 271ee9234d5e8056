"""A second opinion: some directions measured again by plain FCL, and every difference named."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import PlanningError
from puncture_twin.planning.clearance.engine import AxisDistances
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.geometry.mesh import TriangleMesh

AGREE_MM = 1e-6
"""Two exact engines differ by rounding alone: 1e-12 of a metre and a thousand operations."""


class CrossCheckError(PlanningError):
    """The engine and FCL disagree: a defect of this program, not of its input."""


@dataclass(frozen=True)
class CrossChecked:
    """How many pairs of direction and structure were measured twice, and their largest difference."""

    directions: int
    pairs: int
    largest_mm: float


def cross_check(
    found: AxisDistances,
    meshes: tuple[TriangleMesh, ...],
    target_ct: Floats,
    outward_ct: Floats,
    length: Floats | float,
    *,
    count: int,
    rng: np.random.Generator,
) -> CrossChecked:
    """Measure some of the directions again with `FclEngine`.

    Args:
        found: What an engine measured, n directions and k structures.
        meshes: The k surfaces.
        target_ct: Shape (3,).
        outward_ct: Shape (n, 3), unit vectors.
        length: Of the axes, one number, shape (k,) or (n, k), mm.
        count: How many directions to measure again; all of them if there are fewer.
        rng: Chooses them.

    Raises:
        CrossCheckError: A distance differs by more than rounding.
    """
    rows = rng.choice(len(outward_ct), min(count, len(outward_ct)), replace=False)
    rated = FclEngine(meshes).measure(target_ct, outward_ct[rows], np.broadcast_to(length, found.distance.shape)[rows])
    difference = np.abs(rated.distance - found.distance[rows])
    if difference.size and difference.max() > AGREE_MM:
        row, column = np.unravel_index(int(difference.argmax()), difference.shape)
        raise CrossCheckError(
            f"direction {rows[row]}, structure {column}: the engine says {found.distance[rows[row], column]:.9f} mm,"
            f" FCL {rated.distance[row, column]:.9f} mm"
        )
    return CrossChecked(len(rows), difference.size, float(difference.max(initial=0.0)))
