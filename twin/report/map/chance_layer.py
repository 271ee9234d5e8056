"""The map's layer of probability: how likely a needle touches nothing that it must not touch.

Lines and hatching, no colours: they read over every shade of safe, in print, and for colour-blind people. The chance to
hit hardly changes with the direction, so that it stands beside the map as a number.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from scipy import ndimage

from puncture_twin.planning.search.candidates import Candidates

LEVELS = (0.5, 0.9, 0.99)
STYLES = (":", "--", "-")
"""Of the line of each level."""

HATCHES = ("xxxx", "////", "..", "")
"""Below the first level, between the levels, above the last."""

SMOOTHED = 0.006
"""Of the picture's side: the cells' corners are rounded off, and lines move by less than half a cell."""


def touch_nothing(candidates: Candidates) -> NDArray[np.float64] | None:
    """1 - p_touch_any of every direction, shape (n,), NaN where there is none; None without any."""
    if candidates.chances is None or not np.isfinite(candidates.chances.touch_any).any():
        return None
    return np.asarray(1.0 - candidates.chances.touch_any)


def chance_raster(candidates: Candidates, rows: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """The chance under each pixel, smoothed within the region that has chances; NaN elsewhere; None without any.

    Args:
        candidates: The grid.
        rows: Shape (n, n), the candidate under each pixel, -1 outside.
    """
    chance = touch_nothing(candidates)
    if chance is None:
        return None
    picture = np.append(chance, np.nan)[rows]
    known = np.isfinite(picture)
    wide = SMOOTHED * len(rows)
    weight = ndimage.gaussian_filter(known.astype(float), wide)
    smooth = ndimage.gaussian_filter(np.where(known, picture, 0.0), wide) / np.maximum(weight, 1e-9)
    return np.asarray(np.where(known, smooth, np.nan))


def draw_chances(axes: Axes, candidates: Candidates, rows: NDArray[np.int64]) -> None:
    """Hatch and line the region that has chances."""
    chance = chance_raster(candidates, rows)
    if chance is None:
        return
    axis = (np.arange(len(rows)) + 0.5) / len(rows) * 2 - 1
    shown = np.ma.masked_invalid(chance)
    with_ends = (-1.0, *LEVELS, 2.0)
    hatched = axes.contourf(axis, -axis, shown, levels=with_ends, colors="none", hatches=list(HATCHES), zorder=3.4)
    hatched.set_edgecolor((0.0, 0.0, 0.0, 0.55))
    hatched.set_linewidth(0.0)
    if not np.nanmin(chance) < LEVELS[-1]:
        return
    for width, colour in ((3.4, "white"), (1.5, "black")):
        axes.contour(axis, -axis, shown, levels=LEVELS, colors=colour, linestyles=STYLES, linewidths=width, zorder=3.6)


def chance_legend(axes: Axes, candidates: Candidates, y: float) -> float:
    """What lines and hatching mean; nothing without chances. Returns where the next line may stand."""
    chance = touch_nothing(candidates)
    if chance is None:
        return y
    axes.text(0.0, y + 0.03, "chance to touch nothing forbidden", fontsize=9.5, va="center")
    text = (f"< {LEVELS[0]:g}", *(f"{low:g}–{high:g}" for low, high in pairwise(LEVELS)))
    for place, (name, hatch) in enumerate(zip((*text, f"> {LEVELS[-1]:g}"), HATCHES, strict=True)):
        x = 0.25 * place
        box = Rectangle((x, y + 0.05), 0.07, 0.028, facecolor="#cdebdc", edgecolor="0.2", hatch=hatch, lw=0.8)
        axes.add_patch(box)
        axes.text(x + 0.08, y + 0.064, name, fontsize=8.5, va="center")
        if place < len(LEVELS):
            axes.plot([x + 0.235, x + 0.235], [y + 0.05, y + 0.078], color="black", ls=STYLES[place], lw=1.5)
    return y + 0.065
