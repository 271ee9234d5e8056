"""``map.png``: every entry direction, seen from outside, with the reason for each refusal."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from scipy import ndimage

from puncture_twin.planning.base.arrays import Bools, Texts
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.search.candidates import Candidates, Verdict
from puncture_twin.planning.search.selection.choice import Pick, best_pick
from puncture_twin.planning.search.selection.windows import MOST_WINDOWS, find_windows
from puncture_twin.twin.report.map.chance_layer import draw_chances
from puncture_twin.twin.report.map.front import shown_front
from puncture_twin.twin.report.map.map_raster import MapRaster, map_raster
from puncture_twin.twin.report.map.map_side import draw_side
from puncture_twin.twin.report.map_view import BEYOND, MapView, map_view, step_of
from puncture_twin.twin.report.numbers import needle_text, target_text
from puncture_twin.twin.report.palette import PNG_LEVEL

PIXELS = 1120
"""Side of the raster; finer than the picture shows it."""

FIGURE_INCHES = (13.0, 9.4)
DPI = 130
MAP_BOX = (0.015, 0.05, 0.66, 0.85)
SIDE_BOX = (0.685, 0.05, 0.305, 0.85)
RIM = 1.26
"""Half the side of the map's axes; the disc has radius 1, labels lie between."""

NAMED_FRACTION = 0.006
"""Least fraction of the disc that a rejected region needs to carry its structure's name."""

NOT_SEEN_HERE = "not seen"
"""In a region whose directions leave what was scanned; the legend says how."""

NAME_POINTS = 9.0
"""Size of a name, or of a ring's angle; no two of them lie over one another while there is room."""

RINGS_AT = np.radians(67.5)
"""Where the rings' angles are written, counter-clockwise from the right."""

BORDER_OPACITY = 0.45

HALO = (withStroke(linewidth=3.2, foreground="white"),)


class Label(NamedTuple):
    """What is written on the map, and where, in the disc's radii (x right, y up)."""

    x: float
    y: float
    text: str


def draw_map(candidates: Candidates, case: Any, path: Path, pick: Pick | None = None) -> None:
    """Write the map of a search.

    Args:
        candidates: The grid, checked.
        case: The case: ``name``, ``space``, ``T_ct_entry``, ``needle``, ``target_name``.
        path: The PNG to write; it appears whole or not at all.
        pick: The planned candidate, or the one to be shown; None shows the best.
    """
    pick = pick or best_pick(candidates)
    view = map_view(case, candidates)
    raster = map_raster(candidates, view, PIXELS)
    figure = Figure(figsize=FIGURE_INCHES, dpi=DPI, facecolor="white")
    axes = figure.add_axes(MAP_BOX)
    axes.imshow(raster.rgba, extent=(-1, 1, -1, 1), interpolation="antialiased", zorder=1)
    _frame(axes, view)
    draw_chances(axes, candidates, raster.rows)
    _outline(axes, raster, candidates)
    bests = [window.best for window in find_windows(candidates).windows[:MOST_WINDOWS]]
    _names(axes, raster, candidates, [*_ring_labels(view), *_best_labels(view, candidates, bests)])
    _marks(axes, view, candidates, bests, pick)
    _title(figure, case, candidates)
    draw_side(figure.add_axes(SIDE_BOX), candidates, view, pick)
    with atomic(Path(path)) as temporary:
        FigureCanvasAgg(figure)
        figure.savefig(temporary, format="png", pil_kwargs={"compress_level": PNG_LEVEL})


def _frame(axes: Axes, view: MapView) -> None:
    axes.set_xlim(-RIM, RIM)
    axes.set_ylim(-RIM, RIM)
    axes.set_aspect("equal")
    axes.set_axis_off()
    turns = np.linspace(0, 2 * np.pi, 721)
    top = np.degrees(view.theta_max)
    for ring in _rings(view):
        radius = ring / top
        wide = 1.6 if ring == 90 and view.theta_max > BEYOND else 0.7
        axes.plot(radius * np.cos(turns), radius * np.sin(turns), color="black", lw=wide, alpha=0.45, zorder=3)
    for x, y, text in _ring_labels(view):
        _text(axes, x, y, text, size=NAME_POINTS)
    axes.plot(np.cos(turns), np.sin(turns), color="black", lw=1.2, zorder=3)
    for beta in range(0, 360, 30):
        angle = np.radians(beta) + view.turn
        c, s = np.cos(angle), np.sin(angle)
        axes.plot([0, c], [0, s], color="black", lw=0.5, alpha=0.3, zorder=3)
        axes.plot([c, 1.02 * c], [s, 1.02 * s], color="black", lw=1.0, zorder=3)
        axes.text(1.085 * c, 1.07 * s, f"β {beta}°", ha="center", va="center", fontsize=9, color="0.25")
    for text, angle in view.rim:
        # Upright at the sides, so that long words stay in the picture.
        side = abs(np.cos(angle)) > 0.8 and len(text) > 3
        turn = (90 if np.cos(angle) < 0 else -90) if side else 0
        where = 1.215 * np.cos(angle), 1.16 * np.sin(angle)
        axes.text(*where, text, ha="center", va="center", fontsize=14, fontweight="bold", rotation=turn)


def _rings(view: MapView) -> range:
    """θ of the rings that are drawn, degrees."""
    top = np.degrees(view.theta_max)
    spacing = 15 if top <= 100 else 30
    return range(spacing, int(top) + 1, spacing)


def _ring_labels(view: MapView) -> list[Label]:
    """The rings' angles."""
    radii = [(ring, ring / float(np.degrees(view.theta_max))) for ring in _rings(view)]
    return [Label(r * np.cos(RINGS_AT), r * np.sin(RINGS_AT), f"θ {ring}°") for ring, r in radii]


def _best_labels(view: MapView, candidates: Candidates, bests: list[int]) -> list[Label]:
    """The rings around the best of each window, each as large as two letters."""
    return [Label(x, y, "OO") for x, y in view.place(candidates.theta[bests], candidates.beta[bests])]


def _outline(axes: Axes, raster: MapRaster, candidates: Candidates) -> None:
    safe = np.append(candidates.safe, False)[raster.rows]
    if safe.any() and not safe.all():
        axis = (np.arange(PIXELS) + 0.5) / PIXELS * 2 - 1
        axes.contour(axis, -axis, safe.astype(float), levels=[0.5], colors="black", linewidths=1.3, zorder=4)


def _names(axes: Axes, raster: MapRaster, candidates: Candidates, written: list[Label]) -> None:
    """Write into every large enough region what forbids it, off what is written there, and part regions by a line."""
    every, coded = np.unique(np.append(_region_names(candidates.verdict), ""), return_inverse=True)
    codes = coded[raster.rows]
    parted = np.zeros(codes.shape, dtype=bool)
    parted[:-1] = (codes[1:] != codes[:-1]) & (codes[1:] * codes[:-1] > 0)
    parted[:, :-1] |= (codes[:, 1:] != codes[:, :-1]) & (codes[:, 1:] * codes[:, :-1] > 0)
    border = np.zeros((*codes.shape, 4), dtype=np.uint8)
    border[ndimage.binary_dilation(parted, np.ones((3, 3))), 3] = round(255 * BORDER_OPACITY)
    axes.imshow(border, extent=(-1, 1, -1, 1), interpolation="antialiased", zorder=2)
    coarse = codes[::4, ::4]
    free = np.ones(coarse.shape, dtype=bool)
    for x, y, text in written:
        _taken(free, *_pixel(x, y, len(coarse)), *_half_size(text, len(coarse)))
    for depth, structure in _regions(coarse, list(map(str, every))):
        text = structure.replace("_", " ")
        high, wide = _half_size(text, len(coarse))
        space = np.where(ndimage.minimum_filter(free, (2 * high + 1, 2 * wide + 1)), depth, 0.0)
        row, column = np.unravel_index(int(np.where(space.any(), space, depth).argmax()), depth.shape)
        _taken(free, int(row), int(column), high, wide)
        x, y = (column + 0.5) / len(coarse) * 2 - 1, 1 - (row + 0.5) / len(coarse) * 2
        _text(axes, x, y, text, size=NAME_POINTS, style="italic")


def _region_names(verdict: Verdict) -> Texts:
    """What is written over each direction, shape (n,): the structure that forbids it, or "unknown" and why."""
    unknown = verdict.reason == Reason.UNKNOWN_REGION.value
    named = np.where(verdict.reason == Reason.TOO_CLOSE.value, verdict.structure, "").astype(object)
    whys = np.where(verdict.not_seen, NOT_SEEN_HERE, verdict.structure)
    named[unknown] = [f"unknown:\n{why}" for why in whys[unknown]]
    return np.asarray(named)


def _regions(codes: NDArray[np.int64], names: list[str]) -> list[tuple[NDArray[np.float64], str]]:
    """Large enough regions of one name, the largest first: how deep inside each pixel lies, and the name."""
    found = []
    for code, name in enumerate(names):
        labels, _ = ndimage.label((codes == code) if name else np.zeros(codes.shape, dtype=bool))
        areas = ndimage.sum_labels(np.ones_like(labels), labels, np.arange(1, labels.max() + 1))
        for part in np.flatnonzero(areas > NAMED_FRACTION * codes.size * np.pi / 4) + 1:
            depth = ndimage.distance_transform_edt(np.pad(labels == part, 1))[1:-1, 1:-1]
            found.append((float(areas[part - 1]), depth, name))
    return [(depth, name) for _, depth, name in sorted(found, key=lambda region: -region[0])]


def _half_size(text: str, size: int) -> tuple[int, int]:
    """Half the height and half the width of a name, in pixels of a square picture of the disc."""
    radius_points = MAP_BOX[3] * FIGURE_INCHES[1] * 72 / (2 * RIM)
    pixel_points = radius_points / (size / 2)
    lines = text.split("\n")
    high, wide = 0.7 * NAME_POINTS * len(lines), 0.29 * NAME_POINTS * max(map(len, lines))
    return round(high / pixel_points), round(wide / pixel_points)


def _pixel(x: float, y: float, size: int) -> tuple[int, int]:
    """Row and column of a point of the disc (x right, y up) in a square picture of it."""
    return round((1 - y) / 2 * size), round((1 + x) / 2 * size)


def _taken(free: Bools, row: int, column: int, high: int, wide: int) -> None:
    """Mark a name's box about a pixel, half so high and wide, in place."""
    free[max(0, row - high) : row + high + 1, max(0, column - wide) : column + wide + 1] = False


def _marks(axes: Axes, view: MapView, candidates: Candidates, bests: list[int], pick: Pick | None) -> None:
    def put(rows: Any, of: Candidates = candidates, **look: Any) -> None:
        points = view.place(of.theta[rows], of.beta[rows])
        axes.scatter(points[:, 0], points[:, 1], **look)

    axes.plot([0], [0], marker="+", color="black", ms=9, mew=1.2, zorder=5)
    put(shown_front(candidates, view).rows, s=9, c="white", edgecolors="black", linewidths=0.5, zorder=6)
    put(bests, s=46, facecolors="none", edgecolors="black", linewidths=1.2, zorder=7)
    if pick is not None:
        put([pick.row], pick.candidates, s=330, marker="*", c="white", edgecolors="black", linewidths=1.6, zorder=8)


def _title(figure: Figure, case: Any, candidates: Candidates) -> None:
    figure.text(0.02, 0.955, f"{case.name}: entry directions to {target_text(case)}", fontsize=19, fontweight="bold")
    line = f"{len(candidates):,} directions, step {np.degrees(step_of(candidates)):g}°;  {needle_text(case)}"
    if not candidates.arm_checked:
        line += ";  ARM NOT CHECKED"
    figure.text(0.02, 0.918, line, fontsize=12, color="0.25")
    figure.text(0.985, 0.012, "research software, not a medical device", fontsize=9, color="0.4", ha="right")


def _text(axes: Axes, x: float, y: float, text: str, *, size: float, style: str = "normal") -> None:
    axes.text(x, y, text, fontsize=size, style=style, ha="center", va="center", zorder=9, path_effects=list(HALO))
