"""``map.png``: every entry direction, seen from outside, with the reason for each refusal.

Beside the disc a column: what its colours and marks mean, and the chosen direction in numbers.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text

from puncture_twin.planning.base.reasons import NOT_SEARCHED_TEXT, UNSEEN_AIR, Reason, Rgb, css
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.search.candidates import Candidates, Pick
from puncture_twin.planning.search.uncertainty_breakdown import chance_text
from puncture_twin.twin.report.figures import figure_of, write_png
from puncture_twin.twin.report.map.map_disc import (
    BEST,
    CHOSEN,
    DPI,
    FRONT,
    HATCH_INK,
    HATCHES,
    LEVELS,
    RADIUS,
    STYLES,
    draw_disc,
    touch_nothing,
)
from puncture_twin.twin.report.map.map_raster import (
    HATCH,
    HATCH_AIR,
    SCALE_DIGITS,
    ClearanceScale,
    MapRaster,
    clearance_scale,
    map_raster,
    shown_front,
)
from puncture_twin.twin.report.map_view import BEYOND, MapView, map_view, step_of
from puncture_twin.twin.report.numbers import (
    ReasonCount,
    arm_text,
    length_text,
    nearest_text,
    needle_text,
    reason_counts,
    target_text,
)
from puncture_twin.twin.report.palette import safe_shades
from puncture_twin.twin.report.present import number, percent

WIDTH, HEIGHT = 1690, 1222

DISC = ((583 - RADIUS) / WIDTH, 1 - (642 + RADIUS) / HEIGHT, 2 * RADIUS / WIDTH, 2 * RADIUS / HEIGHT)
SIDE_WIDE, SIDE_HIGH = 515, 1039
SIDE = (1158 / WIDTH, 1 - (122 + SIDE_HIGH) / HEIGHT, SIDE_WIDE / WIDTH, SIDE_HIGH / HEIGHT)
"""Of the picture: left, lower edge, width and height of the disc and of the column beside it; labels stand around the
disc."""

SMALL = 9.5
"""Points: letters of the column."""


def draw_map(
    candidates: Candidates,
    case: Any,
    path: Path,
    pick: Pick | None = None,
    raster: MapRaster | None = None,
    scan: Any | None = None,
) -> None:
    """Write the map of a search.

    Args:
        case: The case: ``name``, ``space``, ``T_ct_entry``, ``needle``, ``target_name``.
        path: The PNG to write; it appears whole or not at all.
        pick: The planned candidate, or the one to be shown; None shows the best.
        raster: The map's pixels where somebody has them already.
        scan: The CT, whose voxels say how many digits a length has; None for meshes alone.
    """
    write_png(map_figure(candidates, case, pick, raster, scan), path)


def map_figure(
    candidates: Candidates,
    case: Any,
    pick: Pick | None = None,
    raster: MapRaster | None = None,
    scan: Any | None = None,
) -> Figure:
    """The map, arguments as of `draw_map`; the disc is the first of its axes, the column the second."""
    pick = pick or candidates.best
    view = map_view(case, candidates)
    figure = figure_of(WIDTH, HEIGHT, dpi=DPI)
    raster = map_raster(candidates, view) if raster is None else raster
    draw_disc(figure.add_axes(DISC), candidates, view, raster, pick)
    _column(figure.add_axes(SIDE), candidates, view, pick, scan)
    title = f"{case.name}: entry directions to {target_text(case)}"
    figure.text(0.02, 0.955, title, fontsize=19, weight="bold")
    line = f"{plural(len(candidates), 'direction')}, step {np.degrees(step_of(candidates)):g}°;  {needle_text(case)}"
    if not candidates.arm_checked:
        line += ";  ARM NOT CHECKED"
    figure.text(0.02, 0.918, line, fontsize=12, color="0.25")
    figure.text(0.985, 0.012, "research software, not a medical device", fontsize=9, color="0.4", ha="right")
    return figure


def _column(axes: Axes, candidates: Candidates, view: MapView, pick: Pick | None, scan: Any | None) -> None:
    """What the colours and marks mean, the chosen direction, and how to read the map; y 0..1 runs downwards."""
    axes.set_axis_off()
    axes.set(xlim=(0, 1), ylim=(1, 0), autoscale_on=False)
    y = _legend(axes, reason_counts(candidates))
    y = _scale(axes, candidates, y + 0.01)
    y = _chance_legend(axes, candidates, y)
    y = _mark_legend(axes, candidates, view, y + 0.05)
    _chosen(axes, candidates, pick, y + 0.04, scan)
    whole = candidates.grid is None or (candidates.grid.full_circle and candidates.theta.min() < step_of(candidates))
    outside = "" if whole else f"White with lines: {NOT_SEARCHED_TEXT}.\n"
    toward = f"Centre (+), θ = 0: {view.centre}.\n" if view.centre else ""
    if view.theta_max > BEYOND:
        toward += "Beyond the thick ring (θ 90°) the needle comes from the far side.\n"
    text = (
        "HOW TO READ\nThe target is behind the centre; the body is seen\n"
        "from OUTSIDE, along −z of the entry frame. A point is\n"
        "where the needle comes from: θ grows from the centre\n"
        "to the rim, β runs counter-clockwise.\n"
        f"{outside}{toward}{textwrap.fill(arm_text(candidates), 52)}"
    )
    axes.text(0.0, 1.0, text, fontsize=SMALL, va="bottom", linespacing=1.4, color="0.25")


MOST_LEGEND, LINE, GAP = 0.45, 0.0215, 0.6
"""Heights: of the legend's entries together, of the column's; of a line; between two entries, of a line."""

PATCH = 0.06
"""Width of a patch of colour, of the column's."""

TEXT_AT, COUNT_ENDS, GRID_ENDS, ENTRY, MOST_LETTERS = 0.085, 0.62, 0.79, 10.5, 19
"""Of the legend's entries: where text begins and the numbers end; letters in points at most, and as many in a line."""

PADDING = 0.018
"""Between a text and its number at least, of the column's width."""


def _legend(axes: Axes, counts: Sequence[ReasonCount]) -> float:
    """A patch, a text and numbers for each reason; an entry of more lines is higher."""
    for x, text in ((COUNT_ENDS, "directions"), (GRID_ENDS, "of grid"), (1.0, "of solid\nangle")):
        axes.text(x, 0.012, text, fontsize=9, color="0.35", ha="right", va="bottom")
    texts = [_words(axes, one) for one in counts]
    heights = np.array([text.get_text().count("\n") + 1 + GAP for text in texts])
    unit = min(LINE, MOST_LEGEND / float(heights.sum()))
    ends = 0.022 + unit * np.cumsum(heights)
    size = min(ENTRY, unit * SIDE_HIGH / 1.08 * 72 / DPI)
    for one, words, y in zip(counts, texts, (ends - unit * heights / 2).tolist(), strict=True):
        words.set(y=y, fontsize=size)
        _patch(axes, y, 0.032 * min(1.0, unit / 0.015), one)
        numbers = (f"{one.count:,}", percent(one.fraction), percent(one.solid_angle))
        for x, value in zip((COUNT_ENDS, GRID_ENDS, 1.0), numbers, strict=True):
            axes.text(x, y, value, fontsize=size, weight=words.get_fontweight(), ha="right", va="center")
    return float(ends[-1])


def _words(axes: Axes, one: ReasonCount) -> Text:
    """An entry's text, folded so that it ends before its number."""
    look: dict[str, Any] = {"fontsize": ENTRY, "weight": "bold" if one.code == "safe" else "normal"}
    count = axes.text(0.0, 0.0, f"{one.count:,}", **look)
    room = COUNT_ENDS - TEXT_AT - PADDING - _width(count)
    count.remove()
    text = axes.text(TEXT_AT, 0.0, one.text, va="center", linespacing=1.15, **look)
    for letters in range(MOST_LETTERS, 0, -1):
        text.set_text(textwrap.fill(one.text, letters, break_long_words=False, break_on_hyphens=False))
        if _width(text) <= room:
            break
    return text


def _width(text: Text) -> float:
    return float(text.get_window_extent().width) / SIDE_WIDE


def _patch(axes: Axes, y: float, high: float, one: ReasonCount) -> None:
    """A reason's colour, with the lines that the map has over it."""
    hatch, ink = "", (0, 0, 0)
    if one.code == Reason.UNKNOWN_REGION.value:
        hatch, ink = ("\\\\", HATCH_AIR) if one.colour == UNSEEN_AIR else ("//", HATCH)
    _box(axes, y - high / 2, high, one.colour, hatch=hatch, ink=css(ink))


def _box(
    axes: Axes, y: float, high: float, ground: Rgb, x: float = 0.0, *, hatch: str = "", ink: Any = "black"
) -> None:
    """A patch of a colour below a height, hatched with an ink, in a black edge."""
    lines = Rectangle((x, y), PATCH, high, facecolor=css(ground), edgecolor=ink, lw=0, hatch=hatch)
    axes.add_patch(lines)
    axes.add_patch(Rectangle((x, y), PATCH, high, fill=False, lw=0.8, clip_on=False))


def _scale(axes: Axes, candidates: Candidates, y: float) -> float:
    """The shades of safe; one shade where one number says it all."""
    if not candidates.safe.any():
        return y
    scale = clearance_scale(candidates)
    safe = "" if candidates.breathing is not None else f"{candidates.safe_text}, "  # too long for one line
    if scale.even:
        _box(axes, y + 0.02, 0.032, _even_shade(scale))
        axes.text(TEXT_AT, y + 0.036, f"{safe}{_even_text(scale)}", fontsize=SMALL, va="center")
        return y + 0.06
    shades, box = safe_shades(np.linspace(0, 1, 256))[None], (0.0, 1.0, y + 0.045, y + 0.02)
    axes.imshow(shades, extent=box, aspect="auto", interpolation="bilinear")
    axes.add_patch(Rectangle((0.0, y + 0.02), 1.0, 0.025, fill=False, lw=0.8, clip_on=False))
    for x, text, ha in (
        (0.0, number(scale.low, SCALE_DIGITS, "mm"), "left"),
        (0.5, f"{safe}by least clearance", "center"),
        (1.0, number(scale.high, SCALE_DIGITS, "mm"), "right"),
    ):
        axes.text(x, y + 0.05, text, fontsize=SMALL, ha=ha, va="top")
    return y + 0.06


def _even_shade(scale: ClearanceScale) -> Rgb:
    red, green, blue = scale.shades(np.zeros(1))[0].tolist()
    return red, green, blue


def _even_text(scale: ClearanceScale) -> str:
    """Text for what one shade means."""
    if not np.isfinite(scale.low):
        return "no structure has a margin"
    return f"least clearance {number(scale.low, SCALE_DIGITS, 'mm')} everywhere"


PALE: Rgb = (205, 235, 220)
"""Below the legend's hatching."""


def _chance_legend(axes: Axes, candidates: Candidates, y: float) -> float:
    """What lines and hatching mean; nothing without chances. Returns where the next line may stand."""
    if touch_nothing(candidates) is None:
        return y
    axes.text(0.0, y + 0.034, "chance to touch no structure to avoid", fontsize=SMALL, va="center")
    text = (f"< {LEVELS[0]:g}", *(f"{low:g}–{high:g}" for low, high in pairwise(LEVELS)), f"> {LEVELS[-1]:g}")
    for place, (name, hatch) in enumerate(zip(text, HATCHES, strict=True)):
        x = 0.25 * place
        _box(axes, y + 0.05, 0.028, PALE, x, hatch=hatch, ink=HATCH_INK)
        axes.text(x + 0.07, y + 0.064, name, fontsize=8.5, va="center")
        if place < len(LEVELS):
            axes.plot((x + 0.232, x + 0.232), (y + 0.05, y + 0.078), color="black", lw=1.5, ls=STYLES[place])
    return y + 0.065


def _mark_legend(axes: Axes, candidates: Candidates, view: MapView, y: float) -> float:
    if not candidates.safe.any():
        return y
    marks = [(0.03, CHOSEN, 0.07, "chosen"), (0.225, BEST, 0.25, "best of a window")]
    front = shown_front(candidates, view)
    if front.of:
        marks.append((0.575, FRONT, 0.595, front.text))
    for x, mark, beside, text in marks:
        axes.plot([x], [y], **mark)
        axes.text(beside, y, text, fontsize=SMALL, va="center")
    return y


def _chosen(axes: Axes, candidates: Candidates, pick: Pick | None, y: float, scan: Any | None) -> None:
    """The chosen direction in a box; or, in a box of warning, that there is none."""
    box = {"boxstyle": "round,pad=0.45", "facecolor": "#eef7f2", "edgecolor": "#00684a"}
    look: dict[str, Any] = {"fontsize": 10, "linespacing": 1.4, "va": "top", "bbox": box}
    if pick is None:
        text = "NOTHING IS SAFE\nEvery direction of the grid is rejected."
        box |= {"facecolor": "#ffe9e0", "edgecolor": "#b03000"}
        look |= {"fontsize": 13, "weight": "bold", "color": "#a02000"}
    else:
        word = "Best" if pick == candidates.best else "Chosen"
        found, row = pick
        theta, beta = np.degrees(found.theta[row]), np.degrees(found.beta[row])
        text = (
            f"{word}: θ {theta:.4g}°, β {beta:.4g}°{_chances(found, row)}\n"
            f"path in the body {length_text(float(found.path.length[row]), scan)}, "
            f"skin angle {number(float(np.degrees(found.path.skin_angle[row])), 0)}°\n"
            f"{nearest_text(found, row, scan)}"
        )
    axes.text(0.017, y + 0.008, text, **look)


def _chances(candidates: Candidates, row: int) -> str:
    """The chosen direction's chances, to follow it; nothing where there are none."""
    chances = candidates.chances
    if chances is None or not np.isfinite(chances.hit[row]):
        return ""
    hit, touch = chance_text(float(chances.hit[row])), chance_text(float(chances.touch_any[row]))
    return f"; p(hit) {hit}, p(touch) {touch}{'' if chances.refined[row] else ' to first order'}"
