"""The map as pixels, each coloured by the grid cell in which it lies: no gap and no moire can arise.

It is finer than anything that shows it, which smooths the cells' borders. A large Pareto front is thinned, and says so:
hundreds of dots would hide the shades below.

And the disc of the map: rings and azimuths, the layer of chances, names of regions, and marks. The chance that a needle
touches nothing that it must not touch is hatching and lines, no colours: they read over every shade of safe, in print,
and for colour-blind people. The chance to hit hardly changes with the direction: it stands beside the map as a number.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle
from numpy.typing import NDArray
from scipy import ndimage

from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.reasons import REASON_COLOURS, UNSEEN_AIR, Reason, Rgb
from puncture_twin.planning.search.candidates import MOST_WINDOWS, Candidates, Pick, Verdict
from puncture_twin.twin.report.figures import halo
from puncture_twin.twin.report.map_view import BEYOND, MapCells, MapView
from puncture_twin.twin.report.palette import safe_shades

PIXELS = 1120  # side of the raster: twice as fine as the page shows it, finer than the picture does
SCALE_DIGITS = 1  # of the scale's ends, mm; where both print as one number, shades between them would show nothing
EVEN_SHADE = 0.5  # the shade of such a map, 0..1: neither that of the least clearance nor that of the greatest
HATCH: Rgb = (235, 235, 235)
HATCH_AIR: Rgb = (95, 95, 95)
NOT_SEARCHED, HATCH_NOT_SEARCHED = (255, 255, 255), (205, 205, 205)
HATCH_LINES, HATCH_LEAST = 80, 5  # lines across the picture, and pixels between two of them at least
MOST_DOTS = 40  # a front of up to so many directions is shown whole
SPACING, WIDER = 0.04, 1.25  # of a thinned front: least distance of dots in the map's radii, and its growth
SAME = 1e-6  # in the map's radii: directions nearer than this are one, as those of θ = 0 are for every β
LEVELS = (0.5, 0.9, 0.99)
STYLES = (":", "--", "-")  # of the line of each level
HATCHES = ("xxxx", "////", "..", "")  # below the first level, between the levels, above the last
HATCH_INK = (0.0, 0.0, 0.0, 0.55)
COARSE = 2  # every so manyth pixel is looked at: what is smoothed needs no more
SMOOTHED = 0.006  # of the picture's side: the cells' corners are rounded off, and lines move by less than half a cell


@dataclass(frozen=True, eq=False)
class MapRaster:
    """The square picture of the cap, (n, n, 4), clear outside the grid; and each pixel's candidate, (n, n), or -1."""

    rgba: NDArray[np.uint8]  # shape (n, n, 4), transparent outside the grid
    rows: Ints  # shape (n, n), the candidate under each pixel's centre, -1 outside the grid


class ClearanceScale(NamedTuple):
    """The clearances that the shades of safe stand for, mm, `high` the darkest; infinite where nothing has a margin."""

    low: float
    high: float

    @property
    def even(self) -> bool:
        """Whether all clearances read the same: then there is one shade, and no scale."""
        return round(self.low, SCALE_DIGITS) == round(self.high, SCALE_DIGITS)

    def shades(self, clearance: Floats) -> NDArray[np.uint8]:
        """The colour of each clearance, mm, shape (n,) to (n, 3)."""
        if self.even:
            return safe_shades(np.full(np.shape(clearance), EVEN_SHADE))
        return safe_shades((clearance - self.low) / (self.high - self.low))


def clearance_scale(candidates: Candidates) -> ClearanceScale:
    """Range of the clearances of the safe directions; infinite where none of them has a finite one."""
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
    """The raster of the cap of directions."""
    rows = MapCells.of(candidates).picture(view, size)
    table = np.zeros((len(candidates) + 1, 4), dtype=np.uint8)
    table[:-1, :3] = row_colours(candidates)
    table[:-1, 3] = 255
    rgba = table[rows]
    _hatch(rgba, rows, candidates)
    return MapRaster(rgba, rows)


def _hatch(rgba: NDArray[np.uint8], rows: Ints, candidates: Candidates) -> None:
    """Draw lines over what is unknown, in place: rising in the body, falling in air, others where not tested."""
    unknown, air = candidates.verdict.reason == Reason.UNKNOWN_REGION.value, candidates.unseen_air
    line, column = np.arange(len(rows))[:, None], np.arange(len(rows))
    middle = (len(rows) - 1) / 2
    not_searched = (rows < 0) & (np.hypot(line - middle, column - middle) < middle - 1.0) & (rgba[..., 3] == 0)
    rgba[not_searched] = (*NOT_SEARCHED, 255)
    period = max(HATCH_LEAST, len(rows) // HATCH_LINES)
    for where, phase, colour in (
        (np.append(unknown & ~air, False)[rows], line + column, HATCH),
        (np.append(air, False)[rows], line - column, HATCH_AIR),
        (not_searched, line + 0 * column, HATCH_NOT_SEARCHED),
    ):
        rgba[where & (phase % period < max(1, period // 5)), :3] = colour


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
    """Rows of the points (n, 2) that lie no nearer than a distance to any that was taken before them."""
    spaced: list[int] = []
    for i, place in enumerate(places):
        if not spaced or np.linalg.norm(places[spaced] - place, axis=1).min() >= spacing:
            spaced.append(i)
    return np.array(spaced, dtype=np.int64)


RADIUS = 412  # of the disc, pixels
DPI = 130  # dots an inch of the map; letters and lines are in points
RINGS_AT, RINGS_CLEAR = np.radians((67.5, 52.5, 22.5, 112.5, 127.5)), 0.09
"""Angles of the rings' labels, counter-clockwise from the right: the first at which every mark keeps so far
from them, in the disc's radii."""

RIM_LABEL = 0.95  # of the disc's radii: the angle of a ring at the rim stands there, not over the line
BORDER_OPACITY = 0.45  # of the lines between regions of different structures
LETTERS, LETTERS_RIM = 9.0, halo(3.2)  # points: what is written in the disc, and the white about it
CHOSEN: Mapping[str, Any] = {"marker": "*", "ms": 19, "mew": 1.6, "mfc": "white", "mec": "black"}
BEST: Mapping[str, Any] = {"marker": "o", "ms": 6.8, "mew": 1.2, "mfc": "none", "mec": "black"}
FRONT: Mapping[str, Any] = {"marker": "o", "ms": 3.0, "mew": 0.5, "mfc": "white", "mec": "black"}
"""The marks of directions, on the map and in its legend."""


class Label(NamedTuple):
    """Text on the map, and its position, in the disc's radii (x right, y up)."""

    x: float
    y: float
    text: str


def draw_disc(axes: Axes, candidates: Candidates, view: MapView, raster: MapRaster, pick: Pick | None) -> None:
    """Draw the map on square axes of 2 `RADIUS` pixels, in the disc's radii; labels of the rim lie outside of them."""
    axes.set_axis_off()
    axes.set(xlim=(-1, 1), ylim=(-1, 1), autoscale_on=False)
    codes, names = region_codes(candidates.verdict, raster.rows)
    opaque = raster.rgba[..., 3:] / 255.0  # on white, with lines between regions, and about what is safe
    rgb = np.round(raster.rgba[..., :3] * opaque + 255.0 * (1.0 - opaque)).astype(np.uint8)
    between = _edges(codes, named=True)
    rgb[between] = np.round(rgb[between] * (1 - BORDER_OPACITY))
    rgb[_edges(np.append(candidates.safe, False)[raster.rows].astype(np.int64))] = 0
    axes.imshow(rgb, extent=(-1, 1, -1, 1), interpolation="hanning")
    _frame(axes, view)
    _chances(axes, candidates, raster.rows)
    bests = [window.best for window in candidates.windows.windows[:MOST_WINDOWS]]
    marked = view.place(candidates.theta[bests], candidates.beta[bests])
    chosen = np.zeros((0, 2))
    if pick is not None:
        chosen = view.place(pick.candidates.theta[[pick.row]], pick.candidates.beta[[pick.row]])
    rings = ring_labels(view, np.concatenate([marked, chosen]))
    about_bests = [Label(x, y, "OO") for x, y in marked]
    for x, y, text in rings:
        _write(axes, x, y, text)
    for x, y, text in region_labels(codes, names, [*rings, *about_bests]):
        _write(axes, x, y, text, style="italic")
    axes.plot([0], [0], "+", ms=9, mew=1.2, color="black")
    front = shown_front(candidates, view).rows
    dots = view.place(candidates.theta[front], candidates.beta[front])
    for places, mark in ((dots, FRONT), (marked, BEST), (chosen, CHOSEN)):
        axes.plot(*places.T, ls="none", clip_on=False, zorder=4, **mark)  # over all words


def _write(axes: Axes, x: float, y: float, text: str, **look: Any) -> None:
    axes.text(x, y, text, fontsize=LETTERS, ha="center", va="center", path_effects=LETTERS_RIM, **look)


def _edges(values: Ints, *, named: bool = False) -> Bools:
    """Pixels that border on another value; where ``named``, of two that are not 0."""
    shown = np.where(values == 0, np.iinfo(np.int64).max, values) if named else values
    least = ndimage.minimum_filter(shown, 3)
    most = ndimage.maximum_filter(values, 3)
    return np.asarray((least < most) & (values != 0) if named else least < most)


def _frame(axes: Axes, view: MapView) -> None:
    for ring, radius in ring_radii(view):
        line_width = 1.6 if ring == 90 and view.theta_max > BEYOND else 0.7
        axes.add_patch(Circle((0, 0), radius, fill=False, lw=line_width, alpha=0.45))
    axes.add_patch(Circle((0, 0), 1, fill=False, lw=1.2, clip_on=False))
    for beta in range(0, 360, 30):
        angle = np.radians(beta) + view.turn
        x, y = float(np.cos(angle)), float(np.sin(angle))
        axes.plot((0, x), (0, y), lw=0.5, color="black", alpha=0.3)
        axes.plot((x, 1.02 * x), (y, 1.02 * y), lw=1.0, color="black", clip_on=False)
        axes.text(1.085 * x, 1.07 * y, f"β {beta}°", fontsize=LETTERS, ha="center", va="center", color="0.25")
    for text, angle in view.rim:
        # Upright at the sides, so that long words stay in the picture.
        side = abs(np.cos(angle)) > 0.8 and len(text) > 3
        text_angle = (90 if np.cos(angle) < 0 else -90) if side else 0
        x, y = 1.215 * np.cos(angle), 1.16 * np.sin(angle)
        axes.text(x, y, text, rotation=text_angle, ha="center", va="center", fontsize=14, weight="bold")


def ring_radii(view: MapView) -> list[tuple[int, float]]:
    """θ of the rings that are drawn, degrees, and their radius in the disc."""
    top = float(np.degrees(view.theta_max))
    spacing = 15 if top <= 100 else 30
    return [(ring, ring / top) for ring in range(spacing, int(top) + 1, spacing)]


def ring_labels(view: MapView, marks: Floats) -> list[Label]:
    """The rings' angles, off the marks (n, 2) where that is possible; that of a ring at the rim stands within it."""
    radii = np.array([min(radius, RIM_LABEL) for _, radius in ring_radii(view)])
    lines = [radii[:, None] * (np.cos(angle), np.sin(angle)) for angle in RINGS_AT]
    clear = [np.linalg.norm(line[:, None] - marks, axis=2).min(initial=2.0) for line in lines]
    line = next((line for line, far in zip(lines, clear, strict=True) if far > RINGS_CLEAR), lines[0])
    return [Label(x, y, f"θ {ring}°") for (x, y), (ring, _) in zip(line.tolist(), ring_radii(view), strict=True)]


def touch_nothing(candidates: Candidates) -> Floats | None:
    """1 - p_touch_any of every direction, shape (n,), NaN where there is none; None without any."""
    if candidates.chances is None or not np.isfinite(candidates.chances.touch_any).any():
        return None
    return np.asarray(1.0 - candidates.chances.touch_any)


def chance_raster(candidates: Candidates, rows: Ints) -> Floats | None:
    """The chance under each pixel of rows (n, n), smoothed where there are chances; NaN elsewhere; None without any."""
    chance = touch_nothing(candidates)
    if chance is None:
        return None
    picture = np.append(chance, np.nan)[rows]
    known = np.isfinite(picture)
    smoothed = SMOOTHED * len(rows)
    weight = ndimage.gaussian_filter(known.astype(float), smoothed)
    smooth = ndimage.gaussian_filter(np.where(known, picture, 0.0), smoothed) / np.maximum(weight, 1e-9)
    return np.asarray(np.where(known, smooth, np.nan))


def _chances(axes: Axes, candidates: Candidates, rows: Ints) -> None:
    """Hatching and lines over the region that has chances, where they are not all above the last level."""
    chance = chance_raster(candidates, rows[::COARSE, ::COARSE])
    if chance is None or not (chance < LEVELS[-1]).any():
        return
    axis = (np.arange(len(chance)) + 0.5) / len(chance) * 2 - 1
    shown = np.ma.masked_invalid(chance)
    with_ends = (-1.0, *LEVELS, 2.0)
    hatched = axes.contourf(axis, -axis, shown, levels=with_ends, colors="none", hatches=list(HATCHES))
    hatched.set_edgecolor(HATCH_INK)
    hatched.set_linewidth(0.0)
    for width, colour in ((3.4, "white"), (1.5, "black")):
        axes.contour(axis, -axis, shown, levels=LEVELS, colors=colour, linestyles=STYLES, linewidths=width)


NAMED_FRACTION = 0.006  # least fraction of the disc that a rejected region needs to carry its structure's name
NOT_SEEN_HERE = "not seen"  # in a region whose directions leave what was scanned; the legend says how
LETTER_HIGH, LETTER_WIDE = 0.7 * LETTERS * DPI / 72, 0.29 * LETTERS * DPI / 72
"""Pixels: half the room of a line and of a letter; no two names lie over one another while there is room."""

NAMES_COARSE = 4  # every so manyth pixel is looked at to find a name's place


def region_codes(verdict: Verdict, rows: Ints) -> tuple[Ints, list[str]]:
    """Each pixel's name (what forbids its candidate), an index into names, of which the first is empty; rows (n, n)."""
    unknown = verdict.reason == Reason.UNKNOWN_REGION.value
    written = np.where(verdict.reason == Reason.TOO_CLOSE.value, verdict.structure, "").astype(object)
    whys = np.where(verdict.not_seen, NOT_SEEN_HERE, verdict.structure)
    written[unknown] = [f"unknown:\n{why}" for why in whys[unknown]]
    names = ["", *sorted(set(written) - {""})]
    place = {name: i for i, name in enumerate(names)}
    codes = np.array([*map(place.__getitem__, written), 0])
    return codes[rows], names


def region_labels(codes: Ints, names: Sequence[str], written: Sequence[Label]) -> list[Label]:
    """The names of all large enough regions, deep inside them and off what is written there."""
    coarse = codes[::NAMES_COARSE, ::NAMES_COARSE]
    free, size = np.ones(coarse.shape, dtype=bool), len(coarse)
    for x, y, text in written:
        _take(free, round((1 - y) / 2 * size), round((1 + x) / 2 * size), *_half_size(text, size))
    regions, labels = [], []
    for code, name in enumerate(names):
        parts, _ = ndimage.label((coarse == code) if name else np.zeros(coarse.shape, dtype=bool))
        areas = np.bincount(parts.ravel())[1:]
        for part in np.flatnonzero(areas > NAMED_FRACTION * coarse.size * np.pi / 4) + 1:
            depth = ndimage.distance_transform_edt(np.pad(parts == part, 1))[1:-1, 1:-1]
            regions.append((float(areas[part - 1]), depth, name))
    for _, depth, structure in sorted(regions, key=lambda region: -region[0]):
        text = structure.replace("_", " ")
        rows, columns = _half_size(text, len(coarse))
        space = np.where(ndimage.minimum_filter(free, (2 * rows + 1, 2 * columns + 1)), depth, 0.0)
        row, column = np.unravel_index(int(np.where(space.any(), space, depth).argmax()), depth.shape)
        _take(free, int(row), int(column), rows, columns)
        x, y = (column + 0.5) / len(coarse) * 2 - 1, 1 - (row + 0.5) / len(coarse) * 2
        labels.append(Label(float(x), float(y), text))
    return labels


def _half_size(text: str, size: int) -> tuple[int, int]:
    """Half the height and half the width of a name with some white, in pixels of a square picture of the disc."""
    scale, lines = size / (2 * RADIUS), text.split("\n")
    return round(LETTER_HIGH * len(lines) * scale), round(LETTER_WIDE * (max(map(len, lines)) + 1) * scale)


def _take(free: Bools, row: int, column: int, rows: int, columns: int) -> None:
    """Mark a name's box, so many rows and columns to each side of a pixel, in place."""
    free[max(0, row - rows) : row + rows + 1, max(0, column - columns) : column + columns + 1] = False
