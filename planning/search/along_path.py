"""What lies along one path: the CT's Hounsfield units beside the structures that the case names there."""

from __future__ import annotations

from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.containment import holds
from puncture_twin.planning.geometry.crossings import crossings

STEP_MM = 1.0
"""Between two samples: finer than the voxels of nearly every CT."""
BEYOND_SKIN_MM = 30.0
"""How far outside of the skin the path is followed."""


class Stretch(NamedTuple):
    """A part of a path along which the same structures are.

    Attributes:
        start_mm: From the target.
        end_mm: From the target.
        structures: Names of the closed structures that hold it.
        hu_low: Least Hounsfield units of its samples, NaN where the image does not reach.
        hu_median: Their median.
        hu_high: Their greatest.
    """

    start_mm: float
    end_mm: float
    structures: tuple[str, ...]
    hu_low: float
    hu_median: float
    hu_high: float


def stretches(anatomy: Anatomy, target_ct: Floats, outward_ct: Floats, path_length: float) -> tuple[Stretch, ...]:
    """Follow a path from the target to ``BEYOND_SKIN_MM`` outside of the skin; empty without a CT.

    Args:
        anatomy: With its scan.
        target_ct: Shape (3,), LPS mm.
        outward_ct: Shape (3,), unit.
        path_length: Target to skin, mm; NaN without an entry: nothing is followed.
    """
    if anatomy.scan is None or not np.isfinite(path_length):
        return ()
    depths = np.arange(0.0, path_length + BEYOND_SKIN_MM, STEP_MM)
    hu = anatomy.scan.hu_at(target_ct + depths[:, None] * outward_ct)
    around = np.array([inside_at(s, target_ct, outward_ct, depths) for s in anatomy.checked if s.mesh.closed])
    names = np.array([s.name for s in anatomy.checked if s.mesh.closed], dtype=object)
    keys = [(*names[around[:, row]], "" if depth <= path_length else "outside") for row, depth in enumerate(depths)]
    found, first = [], 0
    for key, group in groupby(keys):
        rows = slice(first, first + len(list(group)))
        first = rows.stop
        end = depths[rows][-1] + STEP_MM
        found.append(Stretch(float(depths[rows][0]), float(end), tuple(filter(None, key)), *_range(hu[rows])))
    return tuple(found)


def inside_at(structure: Structure, target_ct: Floats, outward_ct: Floats, depths: Floats) -> NDArray[np.bool_]:
    """At which depths the path is inside a closed structure: the parity of the crossings before.

    Args:
        structure: Closed.
        target_ct: Shape (3,), mm.
        outward_ct: Shape (3,), unit.
        depths: Shape (n,), from the target outward, mm.
    """
    points = target_ct + depths[:, None] * outward_ct
    low, high = structure.mesh.bounds
    if not np.any(np.all((low <= points) & (points <= high), axis=1)):
        return np.zeros(len(depths), bool)
    crossed = np.sort(crossings(structure.mesh, target_ct, outward_ct[None]).depth)
    inside = holds(structure.mesh, target_ct)
    return np.asarray((np.searchsorted(crossed, depths) % 2 == 1) != inside)


def _range(hu: Floats) -> tuple[float, float, float]:
    seen = hu[np.isfinite(hu)]
    if not len(seen):
        return float("nan"), float("nan"), float("nan")
    return float(seen.min()), float(np.median(seen)), float(seen.max())
