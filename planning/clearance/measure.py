"""Clearance of every candidate to every structure, and FCL's verdict on each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.clearance.engine import AxisDistances, ClearanceEngine
from puncture_twin.planning.clearance.too_near import too_near
from puncture_twin.planning.geometry.containment import holds


@dataclass(frozen=True, eq=False)
class Clearances:
    """Needle to organ, for n candidates and k structures; mm.

    Attributes:
        clearance: Shape (n, k), axis distance minus needle radius, never below minus the radius.
        depth: Shape (n, k), where along the needle, from the target.
        violated: Shape (n, k), the structure demands a margin and does not get it, by its distance or by FCL's word.
    """

    clearance: Floats
    depth: Floats
    violated: NDArray[np.bool_]


def measure(
    engine: ClearanceEngine,
    structures: tuple[Structure, ...],
    target_ct: Floats,
    outward_ct: Floats,
    *,
    length: Floats | float,
    radius: float,
    axes: AxisDistances | None = None,
) -> Clearances:
    """Measure all candidates.

    Every axis starts at the target: where the target lies inside a closed structure, the whole axis is inside it or
    crosses its surface, and the distance is 0 whatever the surfaces say.

    Args:
        engine: Prepared for the meshes of ``structures``, in that order.
        structures: The k structures.
        target_ct: Shape (3,).
        outward_ct: Shape (n, 3), unit vectors.
        length: How far the needle's axis goes from the target, one number or shape (k,), mm.
        radius: Needle radius, mm.
        axes: What the engine has measured of them already; None measures them.
    """
    lengths = np.broadcast_to(np.asarray(length, dtype=np.float64), len(structures))
    if axes is None:
        axes = engine.measure(target_ct, outward_ct, lengths)
        distance, depth = axes.distance, axes.depth
    else:  # the caller's, who needs them as they are
        distance, depth = axes.distance.copy(order="K"), axes.depth.copy(order="K")  # a structure's row by row
    violated = np.zeros_like(distance, bool)
    for column, structure in enumerate(structures):
        if holds(structure.mesh, target_ct):
            distance[:, column] = depth[:, column] = 0.0
        if structure.demands_margin:
            limit = radius + structure.margin_mm
            violated[:, column] = too_near(
                engine, column, target_ct, outward_ct, float(lengths[column]), distance[:, column], limit
            )
    distance -= radius
    return Clearances(distance, depth, violated)
