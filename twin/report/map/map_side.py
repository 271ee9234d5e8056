"""The column beside the map: what its colours and marks mean, and the chosen direction in numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.patches import Rectangle

from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.doubt import chance_text
from puncture_twin.planning.search.selection.choice import Pick, best_pick
from puncture_twin.twin.report.map.chance_layer import chance_legend
from puncture_twin.twin.report.map.front import shown_front
from puncture_twin.twin.report.map.map_raster import SCALE_DIGITS, ClearanceScale, clearance_scale
from puncture_twin.twin.report.map_view import BEYOND, MapView
from puncture_twin.twin.report.numbers import arm_text, nearest_structure, number, percent, reason_counts
from puncture_twin.twin.report.palette import safe_shades

MOST_LEGEND = 0.45
"""Height of the legend's lines together, of the column's: more reasons stand closer."""


def draw_side(axes: Axes, candidates: Candidates, view: MapView, pick: Pick | None) -> None:
    """Draw the column: what the colours and marks mean, the chosen direction, and how to read the map."""
    axes.set_xlim(0, 1)
    axes.set_ylim(1, 0)
    axes.set_axis_off()
    y = _legend(axes, candidates)
    y = _scale(axes, candidates, y + 0.03)
    y = chance_legend(axes, candidates, y)
    y = _mark_legend(axes, candidates, view, y + 0.05)
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
    """The shades of safe; one shade where one number says it all."""
    if not candidates.safe.any():
        return y
    scale = clearance_scale(candidates)
    safe = "" if candidates.breathing is not None else f"{candidates.safe_text}, "  # too long for one line
    if scale.even:
        axes.add_patch(Rectangle((0.0, y + 0.02), 0.06, 0.032, facecolor=_even_shade(scale), edgecolor="black", lw=0.8))
        axes.text(0.085, y + 0.036, f"{safe}{_even_text(scale)}", fontsize=9.5, va="center")
        return y + 0.06
    shades = ListedColormap(safe_shades(np.linspace(0, 1, 64)) / 255.0)
    axes.imshow(np.linspace(0, 1, 256)[None], extent=(0.0, 1.0, y + 0.045, y + 0.02), aspect="auto", cmap=shades)
    axes.add_patch(Rectangle((0.0, y + 0.02), 1.0, 0.025, fill=False, edgecolor="black", lw=0.8))
    axes.set_xlim(0, 1)
    axes.set_ylim(1, 0)
    axes.text(0.0, y + 0.05, number(scale.low, SCALE_DIGITS, "mm"), fontsize=9.5, va="top")
    axes.text(1.0, y + 0.05, number(scale.high, SCALE_DIGITS, "mm"), fontsize=9.5, va="top", ha="right")
    axes.text(0.5, y + 0.05, f"{safe}by least clearance", fontsize=9.5, va="top", ha="center")
    return y + 0.06


def _even_shade(scale: ClearanceScale) -> Any:
    return tuple(scale.shades(np.zeros(1))[0] / 255.0)


def _even_text(scale: ClearanceScale) -> str:
    """What one shade stands for."""
    if not np.isfinite(scale.low):
        return "no structure has a margin"
    return f"least clearance {number(scale.low, SCALE_DIGITS, 'mm')} everywhere"


def _mark_legend(axes: Axes, candidates: Candidates, view: MapView, y: float) -> float:
    if not candidates.safe.any():
        return y
    axes.scatter([0.03], [y], s=240, marker="*", c="white", edgecolors="black", linewidths=1.5, clip_on=False)
    axes.text(0.07, y, "chosen", fontsize=9.5, va="center")
    axes.scatter([0.235], [y], s=46, facecolors="none", edgecolors="black", linewidths=1.2)
    axes.text(0.26, y, "best of a window", fontsize=9.5, va="center")
    front = shown_front(candidates, view)
    if front.of:
        axes.scatter([0.6], [y], s=9, c="white", edgecolors="black", linewidths=0.5)
        axes.text(0.62, y, front.text, fontsize=9.5, va="center")
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
