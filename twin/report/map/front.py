"""The Pareto front on the map: hundreds of dots hide the shades below, so a large front is thinned, and says so."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.twin.report.map_view import MapView

MOST_DOTS = 40
"""A front of up to so many directions is shown whole."""

SPACING, WIDER = 0.04, 1.25
"""Of a thinned front, in the map's radii: the least distance of two dots, and its growth while they are too many."""


SAME = 1e-6
"""In the map's radii: directions nearer than this are one, as those of θ = 0 are for every β."""


class ShownFront(NamedTuple):
    """The dots.

    Attributes:
        rows: Shape (k,), the candidates that get one, best rank first.
        of: How many different directions are on the front.
    """

    rows: Ints
    of: int

    @property
    def text(self) -> str:
        """For a legend."""
        return "Pareto front" if len(self.rows) == self.of else f"Pareto front ({len(self.rows)} of {self.of:,})"


def shown_front(candidates: Candidates, view: MapView) -> ShownFront:
    """The safe directions of the Pareto front that the map shows: all, or the best-ranked that keep apart."""
    front = np.flatnonzero(candidates.ranking.pareto & candidates.safe)
    front = front[np.argsort(candidates.ranking.rank[front], kind="stable")]
    places = view.place(candidates.theta[front], candidates.beta[front])
    alone = _apart(places, SAME)
    front, places = front[alone], places[alone]
    rows, spacing = front, SPACING
    while len(rows) > MOST_DOTS:
        rows, spacing = front[_apart(places, spacing)], spacing * WIDER
    return ShownFront(rows, len(front))


def _apart(places: Floats, spacing: float) -> Ints:
    """Which of the points (n, 2) lie no nearer than a distance to any that was kept before them."""
    kept: list[int] = []
    for i, place in enumerate(places):
        if not kept or np.linalg.norm(places[kept] - place, axis=1).min() >= spacing:
            kept.append(i)
    return np.array(kept, dtype=np.int64)
