"""``map.png``: every entry direction, seen from outside, with the reason for each refusal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from scipy import ndimage

from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.doubt import chance_text
from puncture_twin.planning.search.selection.choice import Pick, best_pick
from puncture_twin.planning.search.selection.windows import MOST_WINDOWS, find_windows
from puncture_twin.twin.report.map.chance_layer import chance_legend, draw_chances
from puncture_twin.twin.report.map.map_raster import MapRaster, clearance_range, map_raster
from puncture_twin.twin.report.map_view import MapView, map_view, step_of
from puncture_twin.twin.report.numbers import (
    arm_text,
    nearest_structure,
    needle_text,
    number,
    percent,
    reason_counts,
    target_text,
)
from puncture_twin.twin.report.palette import PNG_LEVEL, safe_shades

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

MOST_LEGEND = 0.45
"""Height of the legend's lines together, of the column's: more reasons stand closer."""

NAMED_REASONS = (Reason.TOO_CLOSE, Reason.UNKNOWN_REGION)
"""Reasons whose structure is written into the map."""

NAME_POINTS = 9.0
"""Size of such a name; no two of them lie over one another while there is room."""

BORDER_OPACITY = 0.45

BEYOND = np.radians(92.0)
"""A map whose rim lies beyond this shows directions from the far side, and says so."""

HALO = (withStroke(linewidth=3.2, foreground="white"),)


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
    _names(axes, raster, candidates)
    _marks(axes, view, candidates, pick)
    _title(figure, case, candidates)
    _side(figure.add_axes(SIDE_BOX), case, candidates, view, pick)
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
    spacing = 15 if top <= 100 else 30
    for ring in range(spacing, int(top) + 1, spacing):
        radius = ring / top
        wide = 1.6 if ring == 90 and view.theta_max > BEYOND else 0.7
        axes.plot(radius * np.cos(turns), radius * np.sin(turns), color="black", lw=wide, alpha=0.45, zorder=3)
        at = np.radians(67.5)
        _text(axes, radius * np.cos(at), radius * np.sin(at), f"θ {ring}°", size=9)
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


def _outline(axes: Axes, raster: MapRaster, candidates: Candidates) -> None:
    safe = np.append(candidates.safe, False)[raster.rows]
    if safe.any() and not safe.all():
        axis = (np.arange(PIXELS) + 0.5) / PIXELS * 2 - 1
        axes.contour(axis, -axis, safe.astype(float), levels=[0.5], colors="black", linewidths=1.3, zorder=4)


def _names(axes: Axes, raster: MapRaster, candidates: Candidates) -> None:
    """Write the structure's name into every large enough region that it forbids, and part the regions by a line."""
    named = np.isin(candidates.verdict.reason, [reason.value for reason in NAMED_REASONS])
    every, coded = np.unique(np.append(np.where(named, candidates.verdict.structure, ""), ""), return_inverse=True)
    codes = coded[raster.rows]
    parted = np.zeros(codes.shape, dtype=bool)
    parted[:-1] = (codes[1:] != codes[:-1]) & (codes[1:] * codes[:-1] > 0)
    parted[:, :-1] |= (codes[:, 1:] != codes[:, :-1]) & (codes[:, 1:] * codes[:, :-1] > 0)
    border = np.zeros((*codes.shape, 4), dtype=np.uint8)
    border[ndimage.binary_dilation(parted, np.ones((3, 3))), 3] = round(255 * BORDER_OPACITY)
    axes.imshow(border, extent=(-1, 1, -1, 1), interpolation="antialiased", zorder=2)
    coarse = codes[::4, ::4]
    free = np.ones(coarse.shape, dtype=bool)
    for depth, structure in _regions(coarse, list(map(str, every))):
        text = structure.replace("_", " ")
        high, wide = (round(part * len(coarse) / 2) for part in _size(text))
        space = np.where(ndimage.minimum_filter(free, (2 * high + 1, 2 * wide + 1)), depth, 0.0)
        row, column = np.unravel_index(int(np.where(space.any(), space, depth).argmax()), depth.shape)
        free[max(0, row - high) : row + high + 1, max(0, column - wide) : column + wide + 1] = False
        x, y = (column + 0.5) / len(coarse) * 2 - 1, 1 - (row + 0.5) / len(coarse) * 2
        _text(axes, x, y, text, size=NAME_POINTS, style="italic")


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


def _size(text: str) -> tuple[float, float]:
    """Half the height and half the width of a name, in the disc's radii."""
    radius_points = MAP_BOX[3] * FIGURE_INCHES[1] * 72 / (2 * RIM)
    return 0.7 * NAME_POINTS / radius_points, 0.29 * NAME_POINTS * len(text) / radius_points


def _marks(axes: Axes, view: MapView, candidates: Candidates, pick: Pick | None) -> None:
    def put(rows: Any, of: Candidates = candidates, **look: Any) -> None:
        points = view.place(of.theta[rows], of.beta[rows])
        axes.scatter(points[:, 0], points[:, 1], **look)

    axes.plot([0], [0], marker="+", color="black", ms=9, mew=1.2, zorder=5)
    put(
        np.flatnonzero(candidates.ranking.pareto & candidates.safe),
        s=9,
        c="white",
        edgecolors="black",
        linewidths=0.5,
        zorder=6,
    )
    bests = [window.best for window in find_windows(candidates).windows[:MOST_WINDOWS]]
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


def _side(axes: Axes, case: Any, candidates: Candidates, view: MapView, pick: Pick | None) -> None:
    axes.set_xlim(0, 1)
    axes.set_ylim(1, 0)
    axes.set_axis_off()
    y = _legend(axes, candidates)
    y = _scale(axes, candidates, y + 0.03)
    y = chance_legend(axes, candidates, y)
    y = _mark_legend(axes, candidates, y + 0.05)
    y = _chosen(axes, candidates, pick, y + 0.035)
    toward = f"Centre (+), θ = 0: {view.centre}.\n" if view.centre else ""
    if view.theta_max > BEYOND:
        toward += "Beyond the thick ring (θ 90°) it comes from the far side.\n"
    axes.text(
        0.0,
        1.0,
        "HOW TO READ\nThe target is behind the centre; you look at the body\n"
        "from OUTSIDE, along −z of the entry frame. A point is\n"
        "where the needle comes from: θ grows from the centre\n"
        "to the rim, β runs counter-clockwise.\n"
        f"{toward}{_folded(arm_text(candidates), 52)}",
        fontsize=9.5,
        color="0.25",
        va="bottom",
        linespacing=1.35,
    )


def _legend(axes: Axes, candidates: Candidates) -> float:
    y = 0.0
    for x, text in ((0.62, "directions"), (0.79, "of grid"), (1.0, "of solid\nangle")):
        axes.text(x, y + 0.012, text, fontsize=9, color="0.35", ha="right", va="bottom")
    counts = reason_counts(candidates)
    for line in counts:
        y += min(0.05, MOST_LEGEND / len(counts))
        bold = "bold" if line.code == "safe" else "normal"
        colour = np.array(line.colour) / 255
        axes.add_patch(Rectangle((0.0, y - 0.017), 0.06, 0.032, facecolor=colour, edgecolor="black", lw=0.8))
        axes.text(0.085, y, _folded(line.text), fontsize=10.5, va="center", fontweight=bold, linespacing=0.95)
        axes.text(0.62, y, f"{line.count:,}", fontsize=10.5, ha="right", va="center", fontweight=bold)
        axes.text(0.79, y, percent(line.fraction), fontsize=10.5, ha="right", va="center", fontweight=bold)
        axes.text(1.0, y, percent(line.solid_angle), fontsize=10.5, ha="right", va="center", fontweight=bold)
    return y


def _folded(text: str, width: int = 19) -> str:
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) + 1 > width and lines[-1]:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)


def _scale(axes: Axes, candidates: Candidates, y: float) -> float:
    """The shades of safe."""
    if not candidates.safe.any():
        return y
    low, high = clearance_range(candidates)
    shades = ListedColormap(safe_shades(np.linspace(0, 1, 64)) / 255.0)
    axes.imshow(np.linspace(0, 1, 256)[None], extent=(0.0, 1.0, y + 0.045, y + 0.02), aspect="auto", cmap=shades)
    axes.add_patch(Rectangle((0.0, y + 0.02), 1.0, 0.025, fill=False, edgecolor="black", lw=0.8))
    axes.set_xlim(0, 1)
    axes.set_ylim(1, 0)
    axes.text(0.0, y + 0.05, number(low, 1, "mm"), fontsize=9.5, va="top")
    axes.text(1.0, y + 0.05, number(high, 1, "mm"), fontsize=9.5, va="top", ha="right")
    safe = "" if candidates.breathing is not None else f"{candidates.safe_text}, "  # too long for one line
    axes.text(0.5, y + 0.05, f"{safe}by least clearance", fontsize=9.5, va="top", ha="center")
    return y + 0.06


def _mark_legend(axes: Axes, candidates: Candidates, y: float) -> float:
    if not candidates.safe.any():
        return y
    axes.scatter([0.03], [y], s=240, marker="*", c="white", edgecolors="black", linewidths=1.5, clip_on=False)
    axes.text(0.075, y, "chosen", fontsize=10.5, va="center")
    axes.scatter([0.27], [y], s=46, facecolors="none", edgecolors="black", linewidths=1.2)
    axes.text(0.3, y, "best of a window", fontsize=10.5, va="center")
    if candidates.ranking.pareto.any():
        axes.scatter([0.72], [y], s=9, c="white", edgecolors="black", linewidths=0.5)
        axes.text(0.75, y, "Pareto front", fontsize=10.5, va="center")
    return y


def _chosen(axes: Axes, candidates: Candidates, pick: Pick | None, y: float) -> float:
    if pick is None:
        text = "NOTHING IS SAFE\nEvery direction of the grid is refused."
        box = {"facecolor": "#ffe9e0", "edgecolor": "#b03000", "boxstyle": "round,pad=0.5"}
        axes.text(0.02, y + 0.03, text, fontsize=13, fontweight="bold", color="#a02000", va="top", bbox=box)
        return y + 0.12
    word = "Best" if pick == best_pick(candidates) else "Chosen"
    candidates, row = pick
    name, clearance = nearest_structure(candidates, row)
    theta, beta = np.degrees(candidates.theta[row]), np.degrees(candidates.beta[row])
    lines = (
        f"{word}: θ {theta:.4g}°, β {beta:.4g}°{_chances(candidates, row)}",
        f"path in the body {number(candidates.path.length[row], 1, 'mm')}, "
        f"skin angle {number(float(np.degrees(candidates.path.skin_angle[row])), 0)}°",
        f"nearest: {name.replace('_', ' ') or 'none'}, {number(clearance, 1, 'mm')}",
    )
    box = {"facecolor": "#eef7f2", "edgecolor": "#00684a", "boxstyle": "round,pad=0.5"}
    axes.text(0.02, y + 0.02, "\n".join(lines), fontsize=10, va="top", linespacing=1.4, bbox=box)
    return y + 0.12


def _chances(candidates: Candidates, row: int) -> str:
    """The chosen direction's chances, to follow it; nothing where there are none."""
    chances = candidates.chances
    if chances is None or not np.isfinite(chances.hit[row]):
        return ""
    hit, touch = chance_text(float(chances.hit[row])), chance_text(float(chances.touch_any[row]))
    return f"; p(hit) {hit}, p(touch) {touch}"


def _text(axes: Axes, x: float, y: float, text: str, *, size: float, style: str = "normal") -> None:
    axes.text(x, y, text, fontsize=size, style=style, ha="center", va="center", zorder=9, path_effects=list(HALO))
