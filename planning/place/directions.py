"""The organ-safe directions that an arm should hold: each with the solid angle that it stands for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.reach.standoff import standoffs
from puncture_twin.planning.search.candidates import Candidates

SAME_RING_DIGITS = 7
"""θ equal to so many digits (rad) belong to one ring of the grid."""


@dataclass(frozen=True, eq=False)
class WantedDirections:
    """n directions.

    Attributes:
        outward_ct: Shape (n, 3), unit, from the target outward.
        standoff_mm: Shape (n,), tip to target before the insertion.
        weight: Shape (n,), fraction of the organ-safe solid angle that each stands for.
    """

    outward_ct: Floats
    standoff_mm: Floats
    weight: Floats

    def __len__(self) -> int:
        return len(self.weight)

    def only(self, rows: NDArray[np.bool_]) -> WantedDirections:
        """Some of them, with their weights."""
        return WantedDirections(self.outward_ct[rows], self.standoff_mm[rows], self.weight[rows])

    def spread(self, count: int) -> WantedDirections:
        """At most ``count`` of them, each as far as can be from those before, with the weight of all nearest to it."""
        if count >= len(self):
            return self
        chosen = [int(np.argmax(self.weight))]
        cosine = self.outward_ct @ self.outward_ct[chosen[0]]
        while len(chosen) < count:
            chosen.append(int(np.argmin(cosine)))
            cosine = np.maximum(cosine, self.outward_ct @ self.outward_ct[chosen[-1]])
        nearest = np.argmax(self.outward_ct @ self.outward_ct[chosen].T, axis=1)
        weight = np.bincount(nearest, self.weight, minlength=count).astype(np.float64)
        return WantedDirections(self.outward_ct[chosen], self.standoff_mm[chosen], weight)


def wanted_directions(case: Case, found: Candidates) -> WantedDirections:
    """The safe rows of a search, in their order."""
    rows = np.flatnonzero(found.safe)
    weight = ring_weights(found.theta, case.search.step)[rows]
    return WantedDirections(
        found.outward_ct[rows],
        standoffs(case.needle, found.path.length[rows], found.path.skin_angle[rows]),
        weight / weight.sum() if len(rows) else weight,
    )


def ring_weights(theta: Floats, step: float) -> Floats:
    """The solid angle of each cell of a grid of (θ, β), up to a common factor: a grid is denser near θ = 0.

    Args:
        theta: Shape (n,), rad.
        step: Of the grid, rad.
    """
    low, high = np.maximum(theta - step / 2, 0.0), np.minimum(theta + step / 2, np.pi)
    _, ring, sizes = np.unique(np.round(theta, SAME_RING_DIGITS), return_inverse=True, return_counts=True)
    return np.asarray((np.cos(low) - np.cos(high)) / sizes[ring])
