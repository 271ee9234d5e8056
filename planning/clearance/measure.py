"""Clearance of every candidate to every structure, and FCL's verdict on each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.clearance.engine import AxisDistances, ClearanceEngine
from puncture_twin.planning.geometry.containment import holds

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
    length: Floats | float,
    distance: Floats,
    limit: float,
) -> NDArray[np.bool_]:
    """Whether axes come nearer to a structure's surface than a limit, shape (n,); FCL decides what is a tie.

    Args:
        engine: Which measured the distances.
        structure: Its place in the engine.
        target_ct: Shape (3,).
        outward_ct: Shape (n, 3), unit vectors.
        length: Of the axes, one number or shape (n,), mm.
        distance: Shape (n,), of the axes from the surface, mm.
        limit: Needle radius plus margin, mm.
    """
    nearer, lengths = distance < limit, np.broadcast_to(length, len(outward_ct))
    for row in np.flatnonzero(np.abs(distance - limit) < NEAR_THRESHOLD_MM):
        nearer[row] = distance[row] < limit - ROUNDING_MM or engine.collides(
            structure, target_ct, outward_ct[row], float(lengths[row]), limit
        )
    return nearer


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
        length: How far the needle's axis goes from the target, one number, shape (k,) or (n, k), mm.
        radius: Needle radius, mm.
        axes: What the engine has measured of them already; None measures them.
    """
    lengths = np.broadcast_to(np.asarray(length, dtype=np.float64), (len(outward_ct), len(structures)))
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
                engine, column, target_ct, outward_ct, lengths[:, column], distance[:, column], limit
            )
    distance -= radius
    return Clearances(distance, depth, violated)
