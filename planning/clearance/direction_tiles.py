"""Directions in bundles: neighbours on the sphere share one walk through the tree."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.kd_order import kd_order

TILE = 12
"""Directions of a bundle at most."""

WIDEST = 0.12
"""Chord from a bundle's axis to its members above which it is divided: about 7 degrees."""

LEAST_BUNDLES = 256
"""A run of fewer bundles is not worth a piece of work of its own."""

CHORD_SLACK = 1e-6
"""More than float32 takes from a chord or a unit vector."""


@dataclass(frozen=True, eq=False)
class Tiles:
    """Directions in an order in which neighbours follow each other, cut into bundles.

    Attributes:
        order: Shape (n,), row of each direction in the caller's order.
        outward: Shape (n, 3), unit vectors in the new order.
        starts: Shape (t + 1,), where each bundle starts.
        middle: Shape (t,), row in ``outward`` of the member amid each bundle: its axis.
        chord: Shape (t,), largest |u - axis| of its members, rounded up.
    """

    order: NDArray[np.int64]
    outward: Floats
    starts: NDArray[np.int64]
    middle: NDArray[np.int64]
    chord: Floats

    def parts(self, most: int) -> list[Tiles]:
        """The same bundles in at most so many runs of about as many each, none below ``LEAST_BUNDLES``."""
        count = max(1, min(most, len(self.middle) // LEAST_BUNDLES))
        edges = np.linspace(0, len(self.middle), count + 1).astype(int)
        return [self._run(low, high) for low, high in itertools.pairwise(edges)]

    def _run(self, low: int, high: int) -> Tiles:
        """Bundles ``low`` to ``high``."""
        first = self.starts[low]
        members = slice(first, self.starts[high])
        starts, middle = self.starts[low : high + 1] - first, self.middle[low:high] - first
        return Tiles(self.order[members], self.outward[members], starts, middle, self.chord[low:high])


def bundle(outward: Floats) -> Tiles:
    """Bundle directions, in any order and number, shape (n, 3), unit vectors."""
    order = kd_order(outward, TILE)
    sorted_outward = np.ascontiguousarray(outward[order], dtype=np.float64)
    starts = _cut(sorted_outward, np.empty(len(outward) + 1, np.int64))
    middle, chord = np.empty(len(starts) - 1, np.int64), np.empty(len(starts) - 1)
    _axes(sorted_outward, starts, middle, chord)
    return Tiles(order, sorted_outward, starts, middle, chord)


@nb.njit(cache=True)
def _cut(outward, starts):  # type: ignore[no-untyped-def]  # numba infers
    """Runs of TILE directions, ended early where the next one is too far from the run's first."""
    count, first = 0, 0
    starts[0] = 0
    for i in range(1, len(outward)):
        if i % TILE == 0 or _square_between(outward, i, first) > WIDEST * WIDEST:
            count += 1
            first = i
            starts[count] = i
    count += 1 if len(outward) else 0
    starts[count] = len(outward)
    return starts[: count + 1].copy()


@nb.njit(cache=True)
def _axes(outward, starts, middle, chord):  # type: ignore[no-untyped-def]  # numba infers
    """The member nearest to the mean of each bundle, and the widest chord from it."""
    for tile in range(len(middle)):
        x, y, z = 0.0, 0.0, 0.0
        for i in range(starts[tile], starts[tile + 1]):
            x, y, z = x + outward[i, 0], y + outward[i, 1], z + outward[i, 2]
        middle[tile], most = starts[tile], -np.inf
        for i in range(starts[tile], starts[tile + 1]):
            along = outward[i, 0] * x + outward[i, 1] * y + outward[i, 2] * z
            if along > most:
                middle[tile], most = i, along
        widest = 0.0
        for i in range(starts[tile], starts[tile + 1]):
            widest = max(widest, _square_between(outward, i, middle[tile]))
        chord[tile] = np.sqrt(widest) * (1 + CHORD_SLACK) + CHORD_SLACK


@nb.njit(cache=True)
def _square_between(outward, i, k):  # type: ignore[no-untyped-def]  # numba infers
    """Square of the chord between two directions."""
    x, y, z = outward[i, 0] - outward[k, 0], outward[i, 1] - outward[k, 1], outward[i, 2] - outward[k, 2]
    return x * x + y * y + z * z
