"""How near the axes at the centres of cells come to the organs, and what follows for all axes of each cell."""

from __future__ import annotations

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray

from planning.certify.cones import Lists
from planning.clearance.segment_triangle import axis_triangle

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class OrganBounds:
    """What holds for every axis of n cells.

    Attributes:
        slack: Shape (n,), no axis lacks more: least distance minus limit, over all structures; inf where none matters.
        tightest: Shape (n,), the structure with that slack.
        largest: Shape (n,), every axis comes at least so near to the structure ``hit``; inf where none is too near.
        hit: Shape (n,), a structure that every axis comes too near to, or -1.
        depth: Shape (n,), how deep on the centre's axis it is so near, mm; NaN without a hit.
    """

    slack: Floats
    tightest: Ints
    largest: Floats
    hit: Ints
    depth: Floats


def organ_bounds(
    corners: Floats,
    group: Ints,
    limits: Floats,
    lists: Lists,
    rows: Ints,
    reach: Floats,
    centres: Floats,
    radius: Floats,
    *,
    length: float,
    pad: float,
) -> OrganBounds:
    """Bound the distances of axes over the cones of some cells; docs/certificate.md, lemmas 1 to 3.

    Args:
        corners: Shape (m, 9), triangles from the target, mm.
        group: Shape (m,), the structure of each, 0 to k - 1.
        limits: Shape (k,), needle radius plus margin.
        lists: Triangles that matter to each cell.
        rows: Shape (n,), the cells to ask for.
        reach: Shape (all cells, k), how far the triangles that matter reach from the target.
        centres: Shape (all cells, 3), unit.
        radius: Shape (all cells,), rad.
        length: Needle, tip to flange, mm.
        pad: A cell is too near where it lacks more than this, mm.
    """
    n = len(rows)
    found = OrganBounds(
        np.full(n, np.inf), np.zeros(n, np.int64), np.full(n, np.inf), np.full(n, -1), np.full(n, np.nan)
    )
    chords = 2 * np.sin(radius / 2)
    out = (found.slack, found.tightest, found.largest, found.hit, found.depth)
    _bound(corners, group, limits, lists.start, lists.items, rows, reach, centres, chords, length, pad, out)
    return found


@nb.njit(cache=True)
def _bound(  # type: ignore[no-untyped-def]  # numba infers
    corners, group, limits, start, items, rows, reach, centres, chords, length, pad, out
):
    slack, tightest, largest, hit, deep = out
    least = np.empty(len(limits))
    for i in range(len(rows)):
        cell = rows[i]
        u, chord = (centres[cell, 0], centres[cell, 1], centres[cell, 2]), chords[cell]
        least[:] = np.inf
        for k in range(start[cell], start[cell + 1]):
            t = items[k]
            g = group[t]
            a = (corners[t, 0], corners[t, 1], corners[t, 2])
            b = (corners[t, 3], corners[t, 4], corners[t, 5])
            c = (corners[t, 6], corners[t, 7], corners[t, 8])
            square, depth = axis_triangle(u, length, a, b, c)
            distance = np.sqrt(square)
            least[g] = min(least[g], distance)
            if distance + depth * chord < limits[g] - pad:  # all over the cell, whatever else is near
                largest[i], hit[i], deep[i] = distance + depth * chord, g, depth
                break
        for g in range(len(limits)):
            lack = least[g] - min(length, reach[cell, g]) * chord - limits[g]
            if lack < slack[i]:
                slack[i], tightest[i] = lack, g
