"""The map as pixels, each of which asks which grid cell it lies in: no gap and no moire can arise.

It is finer than anything that shows it, which smooths the cells' borders. A large Pareto front is thinned, and says so:
hundreds of dots would hide the shades below.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.reasons import REASON_COLOURS, UNSEEN_AIR, Reason, Rgb
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.twin.report.map_view import MapCells, MapView
from puncture_twin.twin.report.palette import safe_shades

PIXELS = 1120
"""Side of the raster that picture and page share: twice as fine as the page shows it, finer than the picture does."""

SCALE_DIGITS = 1  # of the scale's ends, mm; where both print as one number, shades between them would show nothing
EVEN_SHADE = 0.5  # the shade of such a map, 0..1: neither that of the least clearance nor that of the greatest
HATCH: Rgb = (235, 235, 235)
HATCH_AIR: Rgb = (95, 95, 95)
NOT_SEARCHED, HATCH_NOT_SEARCHED = (255, 255, 255), (205, 205, 205)
HATCHES, HATCH_LEAST = 80, 5  # lines across the picture, and pixels between two of them at least


@dataclass(frozen=True, eq=False)
class MapRaster:
    """The square picture of the cap, (n, n, 4), clear outside the grid; and each pixel's candidate, (n, n), or -1."""

    rgba: NDArray[np.uint8]  # shape (n, n, 4), transparent outside the grid
    rows: NDArray[np.int64]  # shape (n, n), the candidate under each pixel's centre, -1 outside the grid


class ClearanceScale(NamedTuple):
    """The clearances that the shades of safe stand for, mm, `high` the darkest; infinite where nothing has a margin."""

    low: float
    high: float

    @property
    def even(self) -> bool:
        """Whether all are one to whoever reads them: then there is one shade, and no scale."""
        return round(self.low, SCALE_DIGITS) == round(self.high, SCALE_DIGITS)

    def shades(self, clearance: Floats) -> NDArray[np.uint8]:
        """The colour of each clearance, mm, shape (n,) to (n, 3)."""
        if self.even:
            return safe_shades(np.full(np.shape(clearance), EVEN_SHADE))
        return safe_shades((clearance - self.low) / (self.high - self.low))


def clearance_scale(candidates: Candidates) -> ClearanceScale:
    """From the least to the greatest clearance among the safe directions; infinite where there is none to speak of."""
    values = candidates.least_clearance[candidates.safe]
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return ClearanceScale(np.inf, np.inf)
    return ClearanceScale(float(values.min()), float(values.max()))


def row_colours(candidates: Candidates) -> NDArray[np.uint8]:
    """The colour of every direction, shape (n, 3)."""
    colours = np.zeros((len(candidates), 3), dtype=np.uint8)
    for value in np.unique(candidates.verdict.reason):
        reason = Reason(str(value))
        if reason in REASON_COLOURS:
            colours[candidates.verdict.reason == value] = REASON_COLOURS[reason]
    safe = candidates.safe
    colours[candidates.unseen_air] = UNSEEN_AIR
    colours[safe] = clearance_scale(candidates).shades(candidates.least_clearance[safe])
    return colours


def map_raster(candidates: Candidates, view: MapView, size: int = PIXELS) -> MapRaster:
    """Draw the cap."""
    rows = MapCells.of(candidates).picture(view, size)
    table = np.zeros((len(candidates) + 1, 4), dtype=np.uint8)
    table[:-1, :3] = row_colours(candidates)
    table[:-1, 3] = 255
    rgba = table[rows]
    _hatch(rgba, rows, candidates)
    return MapRaster(rgba, rows)


def _hatch(rgba: NDArray[np.uint8], rows: NDArray[np.int64], candidates: Candidates) -> None:
    """Lines over what is unknown, in place: rising in the body, falling beside it, others where nobody looked."""
    unknown, air = candidates.verdict.reason == Reason.UNKNOWN_REGION.value, candidates.unseen_air
    line, column = np.arange(len(rows))[:, None], np.arange(len(rows))
    middle = (len(rows) - 1) / 2
    not_searched = (rows < 0) & (np.hypot(line - middle, column - middle) < middle - 1.0) & (rgba[..., 3] == 0)
    rgba[not_searched] = (*NOT_SEARCHED, 255)
    period = max(HATCH_LEAST, len(rows) // HATCHES)
    for where, phase, colour in (
        (np.append(unknown & ~air, False)[rows], line + column, HATCH),
        (np.append(air, False)[rows], line - column, HATCH_AIR),
        (not_searched, line + 0 * column, HATCH_NOT_SEARCHED),
    ):
        rgba[where & (phase % period < max(1, period // 5)), :3] = colour


MOST_DOTS = 40  # a front of up to so many directions is shown whole
SPACING, WIDER = 0.04, 1.25
"""Of a thinned front, in the map's radii: the least distance of two dots, and its growth while they are too many."""


SAME = 1e-6
"""In the map's radii: directions nearer than this are one, as those of θ = 0 are for every β."""


class ShownFront(NamedTuple):
    """The candidates (k,) that get a dot, best rank first, and of how many different directions on the front."""

    rows: Ints  # shape (k,), the candidates that get one, best rank first
    of: int

    @property
    def text(self) -> str:
        """Text for a legend."""
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
