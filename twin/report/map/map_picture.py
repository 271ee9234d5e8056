"""``map.png``: every entry direction, seen from outside, with the reason for each refusal; beside it their key."""

import textwrap
from collections.abc import Sequence
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from puncture_twin.planning.base.reasons import NOT_SEARCHED_TEXT, UNSEEN_AIR, Reason, Rgb, css
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.search.candidates import Candidates, Pick
from puncture_twin.planning.search.uncertainty_breakdown import chance_text
from puncture_twin.twin.report import numbers
from puncture_twin.twin.report.figures import figure_of, write_png
from puncture_twin.twin.report.map import map_raster
from puncture_twin.twin.report.map.map_raster import RADIUS, MapRaster
from puncture_twin.twin.report.map_view import BEYOND, MapView, grid_step, map_view
from puncture_twin.twin.report.palette import safe_shades
from puncture_twin.twin.report.present import number, percent

WIDTH, HEIGHT = 1690, 1222
DISC = ((583 - RADIUS) / WIDTH, 1 - (642 + RADIUS) / HEIGHT, 2 * RADIUS / WIDTH, 2 * RADIUS / HEIGHT)
SIDE_WIDE, SIDE_HIGH = 515, 1039
SIDE = (1158 / WIDTH, 1 - (122 + SIDE_HIGH) / HEIGHT, SIDE_WIDE / WIDTH, SIDE_HIGH / HEIGHT)
"""In the picture: left, lower edge, width and height of the disc and of the column beside it; labels stand around the
disc."""

SMALL = 9.5  # points: letters of the column
GAP = 0.025  # between the parts of the column, of its height
LETTERS, MOST_LINES = 46, 19  # of the key of reasons: letters a line, lines at full size; more of them are smaller
PALE: Rgb = (205, 235, 220)  # below the legend's hatching


def draw_map(
    candidates: Candidates,
    case: Any,
    path: Path,
    pick: Pick | None = None,
    raster: MapRaster | None = None,
    scan: Any = None,
) -> None:
    """Write the map of a search; arguments as of `map_figure`."""
    write_png(map_figure(candidates, case, pick, raster, scan), path)


def map_figure(
    candidates: Candidates, case: Any, pick: Pick | None = None, raster: MapRaster | None = None, scan: Any = None
) -> Figure:
    """The figure of the map, of a raster that was drawn before; lengths in the digits of a scan's voxels.

    The disc is the first of its axes, the column the second.
    """
    pick = pick or candidates.best
    view = map_view(case, candidates)
    figure = figure_of(WIDTH, HEIGHT, dpi=map_raster.DPI)
    raster = map_raster.map_raster(candidates, view) if raster is None else raster
    map_raster.draw_disc(figure.add_axes(DISC), candidates, view, raster, pick)
    _column(figure.add_axes(SIDE), candidates, view, pick, scan)
    title = f"{case.name}: entry directions to {numbers.target_text(case)}"
    figure.text(0.02, 0.955, title, fontsize=19, weight="bold")
    line = f"{plural(len(candidates), 'direction')}, step {np.degrees(grid_step(candidates)):g}°"
    line += f";  {numbers.needle_text(case)}"
    if not candidates.arm_checked:
        line += ";  ARM NOT CHECKED"
    figure.text(0.02, 0.918, line, fontsize=12, color="0.25")
    figure.text(0.985, 0.012, "research software, not a medical device", fontsize=9, color="0.4", ha="right")
    return figure


def _column(axes: Axes, candidates: Candidates, view: MapView, pick: Pick | None, scan: Any | None) -> None:
    """Draw the key of colours and marks, the chosen direction, and how to read the map; y 0..1 runs downwards."""
    axes.set_axis_off()
    axes.set(xlim=(0, 1), ylim=(1, 0), autoscale_on=False)
    y = _reasons(axes, numbers.reason_counts(candidates))
    y = _scale(axes, candidates, y + GAP)
    y = _chance_key(axes, candidates, y)
    y = _mark_key(axes, candidates, view, y)
    _chosen(axes, candidates, pick, y, scan)
    whole = candidates.grid is None or (candidates.grid.full_circle and candidates.theta.min() < grid_step(candidates))
    outside = "" if whole else f"White with lines: {NOT_SEARCHED_TEXT}.\n"
    toward = f"Centre (+), θ = 0: {view.centre}.\n" if view.centre else ""
    if view.theta_max > BEYOND:
        toward += "Beyond the thick ring (θ 90°) the needle comes from the far side.\n"
    text = (
        "HOW TO READ\nThe target is behind the centre; the body is seen\n"
        "from OUTSIDE, along −z of the entry frame. A point is\n"
        "where the needle comes from: θ grows from the centre\n"
        "to the rim, β runs counter-clockwise.\n"
        f"{outside}{toward}{textwrap.fill(numbers.arm_text(candidates), 52)}"
    )
    axes.text(0.0, 1.0, text, fontsize=SMALL, va="bottom", linespacing=1.4, color="0.25")


def _key(axes: Axes, y: float, handles: Sequence[Artist], title: str = "", **look: Any) -> float:
    """A key below a height of the column, each handle with its label; returns where the next part may begin."""
    labels = [str(one.get_label()) for one in handles]
    where = {"loc": "upper left", "bbox_to_anchor": (0.0, 1.0 - y), "alignment": "left", "frameon": False}
    close = {"borderpad": 0.0, "borderaxespad": 0.0, "handletextpad": 0.5, "columnspacing": 0.7, "handlelength": 1.7}
    size = {"title_fontsize": SMALL, "fontsize": SMALL, "handleheight": 1.1}
    key = Legend(axes, handles, labels, title=title, **{**where, **close, **size, **look})
    axes.add_artist(key)
    return 1.0 - (key.get_window_extent().y0 - axes.bbox.y0) / axes.bbox.height + GAP


def _reasons(axes: Axes, counts: Sequence[numbers.ReasonCount]) -> float:
    """Draw the key of reasons: a patch, a text and numbers each, with the lines that the map has over its colour."""
    handles = []
    for one in counts:
        hatch, ink = "", "black"
        if one.code == Reason.UNKNOWN_REGION.value:
            in_air = one.colour == UNSEEN_AIR
            hatch, ink = "\\\\" if in_air else "//", css(map_raster.HATCH_AIR if in_air else map_raster.HATCH)
        text = textwrap.fill(f"{one.text}: {one.count:,} ({percent(one.solid_angle)})", LETTERS)
        handles.append(Patch(facecolor=css(one.colour), edgecolor=ink, hatch=hatch, label=text))
    lines = sum(str(one.get_label()).count("\n") + 1 for one in handles)
    size = 10.5 * min(1.0, MOST_LINES / lines)
    return _key(axes, 0.0, handles, "directions (part of the solid angle)", fontsize=size, labelspacing=0.6)


def _scale(axes: Axes, candidates: Candidates, y: float) -> float:
    if not candidates.safe.any():
        return y
    scale = map_raster.clearance_scale(candidates)
    safe = "" if candidates.breathing is not None else f"{candidates.safe_text}, "  # too long for one line
    if scale.even:
        red, green, blue = scale.shades(np.zeros(1))[0].tolist()
        shade = css((red, green, blue))
        text = "no structure has a margin"
        if np.isfinite(scale.low):
            text = f"least clearance {number(scale.low, map_raster.SCALE_DIGITS, 'mm')} everywhere"
        return _key(axes, y, [Patch(facecolor=shade, edgecolor="black", label=f"{safe}{text}")])
    shades, box = safe_shades(np.linspace(0, 1, 256))[None], (0.0, 1.0, y + 0.025, y)
    axes.imshow(shades, extent=box, aspect="auto", interpolation="bilinear")
    axes.add_patch(Rectangle((0.0, y), 1.0, 0.025, fill=False, lw=0.8, clip_on=False))
    for x, text, ha in (
        (0.0, number(scale.low, map_raster.SCALE_DIGITS, "mm"), "left"),
        (0.5, f"{safe}by least clearance", "center"),
        (1.0, number(scale.high, map_raster.SCALE_DIGITS, "mm"), "right"),
    ):
        axes.text(x, y + 0.03, text, fontsize=SMALL, ha=ha, va="top")
    return y + 0.045 + GAP


def _chance_key(axes: Axes, candidates: Candidates, y: float) -> float:
    if map_raster.touch_nothing(candidates) is None:
        return y
    low, *_, high = map_raster.LEVELS
    text = (f"< {low:g}", *(f"{a:g}–{b:g}" for a, b in pairwise(map_raster.LEVELS)), f"> {high:g}")
    hatched = [
        Patch(facecolor=css(PALE), edgecolor=map_raster.HATCH_INK, hatch=hatch, label=name)
        for name, hatch in zip(text, map_raster.HATCHES, strict=True)
    ]
    levels = zip(map_raster.LEVELS, map_raster.STYLES, strict=True)
    lines = [Line2D([], [], color="black", ls=style, label=f"at {level:g}") for level, style in levels]
    by_column = [one for pair in zip_longest(hatched, lines) for one in pair if one is not None]
    return _key(axes, y, by_column, "chance to touch no structure to avoid: hatched, and lines", ncols=len(hatched))


def _mark_key(axes: Axes, candidates: Candidates, view: MapView, y: float) -> float:
    if not candidates.safe.any():
        return y
    marks = [(map_raster.CHOSEN, "chosen"), (map_raster.BEST, "best of a window")]
    front = map_raster.shown_front(candidates, view)
    marks += [(map_raster.FRONT, front.text)] if front.of else []
    handles = [Line2D([], [], ls="none", label=text, **mark) for mark, text in marks]
    return _key(axes, y, handles, ncols=3, handlelength=1.2)


def _chosen(axes: Axes, candidates: Candidates, pick: Pick | None, y: float, scan: Any | None) -> None:
    box = {"boxstyle": "round,pad=0.45", "facecolor": "#eef7f2", "edgecolor": "#00684a"}
    look: dict[str, Any] = {"fontsize": 10, "linespacing": 1.4, "va": "top", "bbox": box}
    if pick is None:
        text = "NOTHING IS SAFE\nEvery direction of the grid is rejected."
        box |= {"facecolor": "#ffe9e0", "edgecolor": "#b03000"}
        look |= {"fontsize": 13, "weight": "bold", "color": "#a02000"}
    else:
        word = "Best" if pick == candidates.best else "Chosen"
        searched, row = pick
        theta, beta, known = np.degrees(searched.theta[row]), np.degrees(searched.beta[row]), ""
        if (chances := searched.chances) is not None and np.isfinite(chances.hit[row]):
            hit, touch = chance_text(float(chances.hit[row])), chance_text(float(chances.touch_any[row]))
            known = f"; p(hit) {hit}, p(touch) {touch}{'' if chances.refined[row] else ' to first order'}"
        text = (
            f"{word}: θ {theta:.4g}°, β {beta:.4g}°{known}\n"
            f"path in the body {numbers.length_text(float(searched.path.length[row]), scan)}, "
            f"skin angle {number(float(np.degrees(searched.path.skin_angle[row])), 0)}°\n"
            f"{numbers.nearest_text(searched, row, scan)}"
        )
    axes.text(0.017, y + 0.008, text, **look)
