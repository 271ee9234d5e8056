"""The chances to touch of the needles that matter, refined from first order by line sampling."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.clearance.kernels.blocks import Blocks
from puncture_twin.planning.clearance.near_faces import near_faces
from puncture_twin.planning.uncertainty.lines.line_sampling import line_chance
from puncture_twin.planning.uncertainty.lines.needle_doubt import needle_doubt
from puncture_twin.planning.uncertainty.touch import Proximity


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What must not be touched about one target; CT frame, mm.

    Attributes:
        blocks: The faces of each of the k structures.
        length: Shape (k,), of the needle's axis for each.
        target_ct: Shape (3,), where every axis starts.
    """

    blocks: tuple[Blocks, ...]
    length: Floats
    target_ct: Floats


@dataclass(frozen=True, eq=False)
class Needles:
    """n needles and the doubt about them.

    Attributes:
        outward_ct: Shape (n, 3), unit.
        cov_ct: Shape (n, 6, 6), Sigma6, CT axes.
        near: How they pass the k structures, to first order.
        surface_mm: Shape (n, k), by which each structure's surface may lie off as a whole where the needle passes it.
        freedom: Degrees of the errors' size where the residuals gave it.
    """

    outward_ct: Floats
    cov_ct: Floats
    near: Proximity
    surface_mm: Floats
    freedom: int | None


def refined(around: Surroundings, needles: Needles, threshold_mm: Floats, first: Floats, wanted: Bools) -> Floats:
    """First-order chances, those that are wanted refined.

    A structure of which no face is within the needle's reach keeps its first order: it is touched less than once in
    100,000 times.

    Args:
        around: What must not be touched.
        needles: The n needles.
        threshold_mm: Shape (k,), needle radius, or that and a margin.
        first: Shape (n, k), to first order; NaN where a needle meets a structure already.
        wanted: Shape (n, k).

    Returns:
        Shape (n, k).
    """
    found = first.copy()
    rows = np.flatnonzero((wanted & np.isfinite(first)).any(axis=1))
    for row in rows:
        outward = needles.outward_ct[row]
        pose = needle_doubt(around.target_ct, outward, needles.cov_ct[row], 0.0, needles.freedom)
        for column in np.flatnonzero(wanted[row] & np.isfinite(first[row])):
            surface_mm = float(needles.surface_mm[row, column])
            doubt = replace(pose, surface_mm=surface_mm) if surface_mm > 0 else pose
            length, threshold = float(around.length[column]), float(threshold_mm[column])
            reach = doubt.reach(length, threshold)
            if needles.near.distance[row, column] > max(reach):
                continue
            faces = near_faces(around.blocks[column], around.target_ct, outward, length, reach)
            if len(faces):
                chance = line_chance(faces, doubt, length, threshold, needles.near.gradient[row, column])
                found[row, column] = first[row, column] if np.isnan(chance) else chance
    return found
