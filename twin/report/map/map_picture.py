"""``map.png``: every entry direction, seen from outside, with the reason for each refusal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from puncture_twin.planning.base.arrays import Bools, Floats, Ints, Texts
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.search.candidates import Candidates, Verdict
from puncture_twin.planning.search.choice import Pick, best_pick
from puncture_twin.planning.search.windows import MOST_WINDOWS, find_windows
from puncture_twin.twin.report.canvas import BLACK, Canvas, Halo, Words, circle
from puncture_twin.twin.report.map.chance_layer import chance_picture, mark_dot, mark_ring, mark_star
from puncture_twin.twin.report.map.map_raster import (
    HEIGHT,
    MIDDLE,
    POINT,
    RADIUS,
    RINGS_AT,
    Label,
    MapRaster,
    disc_pixels,
    map_raster,
    ring_radii,
    shown_front,
)
from puncture_twin.twin.report.map.map_side import draw_side
from puncture_twin.twin.report.map_view import BEYOND, MapView, map_view, step_of
from puncture_twin.twin.report.numbers import needle_text, target_text
from puncture_twin.twin.report.palette import PNG_LEVEL

WIDTH = 1690

BORDER_OPACITY = 0.45
"""Of the lines between regions of different structures."""

RIM_LABEL = 0.95
"""Of the disc's radii: the angle of a ring at the rim stands there, not over the line."""

RIM_HALO = Halo(1.6 * POINT)
NAME = Words(9 * POINT, "slanted", halo=RIM_HALO)
RING = Words(9 * POINT, halo=RIM_HALO)
AZIMUTH = Words(9 * POINT, colour=(64, 64, 64))
DIRECTION = Words(14 * POINT, "bold")
TITLE, SUBTITLE = Words(19 * POINT, "bold"), Words(12 * POINT, colour=(64, 64, 64))
NOTICE = Words(9 * POINT, colour=(102, 102, 102))


def draw_map(
    candidates: Candidates, case: Any, path: Path, pick: Pick | None = None, raster: MapRaster | None = None
) -> None:
    """Write the map of a search.

    Args:
        candidates: The grid, checked.
        case: The case: ``name``, ``space``, ``T_ct_entry``, ``needle``, ``target_name``.
        path: The PNG to write; it appears whole or not at all.
        pick: The planned candidate, or the one to be shown; None shows the best.
        raster: The map's pixels where somebody has them already.
    """
    pick = pick or best_pick(candidates)
    view = map_view(case, candidates)
    raster = map_raster(candidates, view) if raster is None else raster
    codes, names = region_codes(candidates.verdict, raster.rows)
    canvas = Canvas(WIDTH, HEIGHT)
    _disc(canvas, _lined(raster, candidates, codes))
    _frame(canvas, view)
    chances = chance_picture(candidates, raster.rows, 2 * RADIUS)
    if chances is not None:
        _disc(canvas, chances)
    bests = [window.best for window in find_windows(candidates).windows[:MOST_WINDOWS]]
    rings = _ring_labels(view)
    for x, y, text in rings:
        canvas.write(tuple(disc_pixels((x, y))), text, RING, anchor="mm")
    for x, y, text in region_labels(codes, names, [*rings, *_best_labels(view, candidates, bests)]):
        canvas.write(tuple(disc_pixels((x, y))), text, NAME, anchor="mm")
    _marks(canvas, view, candidates, bests, pick)
    _title(canvas, case, candidates)
    draw_side(canvas, candidates, view, pick)
    with atomic(Path(path)) as temporary:
        canvas.image.convert("RGB").save(temporary, format="PNG", compress_level=PNG_LEVEL)


def _disc(canvas: Canvas, rgba: NDArray[np.uint8]) -> None:
    """Lay a picture of the disc, as fine as it may be, where the disc is."""
    size = 2 * RADIUS
    shown = rgba if len(rgba) == size else _smaller(rgba, size)
    canvas.paste(shown, round(MIDDLE[0]) - RADIUS, round(MIDDLE[1]) - RADIUS)


def _smaller(rgba: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    return np.array(Image.fromarray(rgba).resize((size, size), Image.Resampling.HAMMING))


def _lined(raster: MapRaster, candidates: Candidates, codes: NDArray[np.int64]) -> NDArray[np.uint8]:
    """The raster with lines between regions of different structures, and about what is safe."""
    rgba = raster.rgba.copy()
    between = _edges(codes, named=True)
    rgba[between, :3] = np.round(rgba[between, :3] * (1 - BORDER_OPACITY))
    around = _edges(np.append(candidates.safe, False)[raster.rows].astype(np.int64))
    rgba[around] = (*BLACK, 255)
    return rgba


def _edges(values: NDArray[np.int64], *, named: bool = False) -> Bools:
    """Pixels within one of where two values lie beside each other; where ``named``, of two that are not 0."""
    marked = np.zeros(values.shape, dtype=bool)
    for here, there, at in (
        (values[:-1], values[1:], marked[:-1]),
        (values[:, :-1], values[:, 1:], marked[:, :-1]),
    ):
        at |= (here != there) & ((here * there != 0) | (not named))
    wide = marked.copy()
    wide[1:] |= marked[:-1]
    wide[:-1] |= marked[1:]
    wider = wide.copy()
    wider[:, 1:] |= wide[:, :-1]
    wider[:, :-1] |= wide[:, 1:]
    return wider


def _frame(canvas: Canvas, view: MapView) -> None:
    """Rings, spokes and what lies beyond the rim."""
    for ring, radius in ring_radii(view):
        wide = 1.6 if ring == 90 and view.theta_max > BEYOND else 0.7
        canvas.line(circle(MIDDLE, radius * RADIUS, 180), wide * POINT, BLACK, opacity=0.45)
    canvas.line(circle(MIDDLE, RADIUS, 360), 1.2 * POINT, BLACK)
    for beta in range(0, 360, 30):
        angle = np.radians(beta) + view.turn
        spoke = np.array([np.cos(angle), np.sin(angle)])
        canvas.line(disc_pixels(np.outer([0.0, 1.0], spoke)), 0.5 * POINT, BLACK, opacity=0.3)
        canvas.line(disc_pixels(np.outer([1.0, 1.02], spoke)), POINT, BLACK)
        canvas.write(tuple(disc_pixels(spoke * (1.085, 1.07))), f"β {beta}°", AZIMUTH, anchor="mm")
    for text, angle in view.rim:
        # Upright at the sides, so that long words stay in the picture.
        side = abs(np.cos(angle)) > 0.8 and len(text) > 3
        turned = (1 if np.cos(angle) < 0 else -1) if side else 0
        where = disc_pixels((1.215 * np.cos(angle), 1.16 * np.sin(angle)))
        canvas.write(tuple(where), text, DIRECTION, anchor="mm", turned=turned)


def _ring_labels(view: MapView) -> list[Label]:
    """The rings' angles; that of a ring at the rim stands within it."""
    cosine, sine = float(np.cos(RINGS_AT)), float(np.sin(RINGS_AT))
    radii = [(ring, min(radius, RIM_LABEL)) for ring, radius in ring_radii(view)]
    return [Label(radius * cosine, radius * sine, f"θ {ring}°") for ring, radius in radii]


def _best_labels(view: MapView, candidates: Candidates, bests: list[int]) -> list[Label]:
    """The rings around the best of each window, each as large as two letters."""
    return [Label(x, y, "OO") for x, y in view.place(candidates.theta[bests], candidates.beta[bests])]


def _marks(canvas: Canvas, view: MapView, candidates: Candidates, bests: list[int], pick: Pick | None) -> None:
    """The centre, the Pareto front, the best of each window, and the chosen direction."""

    def places(rows: Any, of: Candidates = candidates) -> Any:
        return disc_pixels(view.place(of.theta[rows], of.beta[rows]))

    x, y = MIDDLE
    canvas.segments(np.array([[(x - 8, y), (x + 8, y)], [(x, y - 8), (x, y + 8)]]), 1.2 * POINT, BLACK)
    for place in places(shown_front(candidates, view).rows):
        mark_dot(canvas, place)
    for place in places(bests):
        mark_ring(canvas, place)
    if pick is not None:
        mark_star(canvas, places([pick.row], pick.candidates)[0], 9.1 * POINT)


def _title(canvas: Canvas, case: Any, candidates: Candidates) -> None:
    left = 0.02 * WIDTH
    canvas.write((left, 0.045 * HEIGHT), f"{case.name}: entry directions to {target_text(case)}", TITLE)
    line = f"{len(candidates):,} directions, step {np.degrees(step_of(candidates)):g}°;  {needle_text(case)}"
    if not candidates.arm_checked:
        line += ";  ARM NOT CHECKED"
    canvas.write((left, 0.082 * HEIGHT), line, SUBTITLE)
    notice = "research software, not a medical device"
    canvas.write((0.985 * WIDTH, 0.988 * HEIGHT), notice, NOTICE, anchor="rs")


NAMED_FRACTION = 0.006
"""Least fraction of the disc that a rejected region needs to carry its structure's name."""

NOT_SEEN_HERE = "not seen"
"""In a region whose directions leave what was scanned; the legend says how."""

LETTER_HIGH, LETTER_WIDE = 0.7 * 9 * POINT, 0.29 * 9 * POINT
"""Pixels: half the room of a line and of a letter; no two names lie over one another while there is room."""

COARSE = 4
"""Every so manyth pixel is looked at to find a name's place."""


def region_codes(verdict: Verdict, rows: Ints) -> tuple[NDArray[np.int64], list[str]]:
    """What is written over each pixel, as its place in a list of names, of which the first is empty.

    Args:
        verdict: Of every direction.
        rows: Shape (n, n), the candidate under each pixel, -1 outside.
    """
    written = _region_names(verdict)
    names = ["", *sorted(set(written) - {""})]
    place = {name: i for i, name in enumerate(names)}
    codes = np.array([*map(place.__getitem__, written), 0])
    return codes[rows], names


def region_labels(codes: NDArray[np.int64], names: Sequence[str], written: Sequence[Label]) -> list[Label]:
    """The names of all large enough regions, deep inside them and off what is written there."""
    coarse = codes[::COARSE, ::COARSE]
    free = np.ones(coarse.shape, dtype=bool)
    for x, y, text in written:
        _take(free, *_pixel(x, y, len(coarse)), *_half_size(text, len(coarse)))
    labels = []
    for depth, structure in _regions(coarse, names):
        text = structure.replace("_", " ")
        high, wide = _half_size(text, len(coarse))
        space = np.where(ndimage.minimum_filter(free, (2 * high + 1, 2 * wide + 1)), depth, 0.0)
        row, column = np.unravel_index(int(np.where(space.any(), space, depth).argmax()), depth.shape)
        _take(free, int(row), int(column), high, wide)
        x, y = (column + 0.5) / len(coarse) * 2 - 1, 1 - (row + 0.5) / len(coarse) * 2
        labels.append(Label(float(x), float(y), text))
    return labels


def _region_names(verdict: Verdict) -> Texts:
    """What is written over each direction, shape (n,): the structure that forbids it, or "unknown" and why."""
    unknown = verdict.reason == Reason.UNKNOWN_REGION.value
    named = np.where(verdict.reason == Reason.TOO_CLOSE.value, verdict.structure, "").astype(object)
    whys = np.where(verdict.not_seen, NOT_SEEN_HERE, verdict.structure)
    named[unknown] = [f"unknown:\n{why}" for why in whys[unknown]]
    return np.asarray(named)


def _regions(codes: NDArray[np.int64], names: Sequence[str]) -> list[tuple[Floats, str]]:
    """Large enough regions of one name, the largest first: how deep inside each pixel lies, and the name."""
    found = []
    for code, name in enumerate(names):
        labels, _ = ndimage.label((codes == code) if name else np.zeros(codes.shape, dtype=bool))
        areas = np.bincount(labels.ravel())[1:]
        for part in np.flatnonzero(areas > NAMED_FRACTION * codes.size * np.pi / 4) + 1:
            depth = ndimage.distance_transform_edt(np.pad(labels == part, 1))[1:-1, 1:-1]
            found.append((float(areas[part - 1]), depth, name))
    return [(depth, name) for _, depth, name in sorted(found, key=lambda region: -region[0])]


def _half_size(text: str, size: int) -> tuple[int, int]:
    """Half the height and half the width of a name, in pixels of a square picture of the disc."""
    scale, lines = size / (2 * RADIUS), text.split("\n")
    return round(LETTER_HIGH * len(lines) * scale), round(LETTER_WIDE * max(map(len, lines)) * scale)


def _pixel(x: float, y: float, size: int) -> tuple[int, int]:
    """Row and column of a point of the disc (x right, y up) in a square picture of it."""
    return round((1 - y) / 2 * size), round((1 + x) / 2 * size)


def _take(free: Bools, row: int, column: int, high: int, wide: int) -> None:
    """Mark a name's box about a pixel, half so high and wide, in place."""
    free[max(0, row - high) : row + high + 1, max(0, column - wide) : column + wide + 1] = False
