"""The map's layer of probability: how likely a needle touches nothing that it must not touch.

Lines and hatching, no colours: they read over every shade of safe, in print, and for colour-blind people. The chance to
hit hardly changes with the direction, so that it stands beside the map as a number.

The marks of directions, on the map and in its legend.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.twin.report.canvas import BLACK, WHITE, Canvas, Words, circle, star
from puncture_twin.twin.report.map.map_raster import POINT, side_pixels

if TYPE_CHECKING:
    from matplotlib.axes import Axes


LEVELS = (0.5, 0.9, 0.99)
STYLES = (":", "--", "-")
"""Of the line of each level."""

HATCHES = ("xxxx", "////", "..", "")
"""Below the first level, between the levels, above the last."""

DASHES = ((2.7, 4.4), (10.0, 4.4), None)
"""The same of the legend's lines: pixels drawn and left out."""

DPI = 130
COARSE = 2
"""Every so manyth pixel is looked at: what is smoothed needs no more."""

SPACING = 6.0
"""Pixels between a hatching's lines in the legend."""

PALE: Rgb = (205, 235, 220)
HEAD, NAME = Words(9.5 * POINT), Words(8.5 * POINT)

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


def chance_picture(candidates: Candidates, rows: NDArray[np.int64], size: int) -> NDArray[np.uint8] | None:
    """Hatching and lines over the region that has chances, RGBA; None where there is nothing to hatch.

    Args:
        candidates: The grid.
        rows: Shape (n, n), the candidate under each pixel, -1 outside.
        size: Of the picture, pixels.
    """
    known = touch_nothing(candidates)
    if known is None or np.nanmin(known) >= LEVELS[-1]:  # smoothed, it is no less
        return None
    chance = chance_raster(candidates, rows[::COARSE, ::COARSE])
    if chance is None or not (chance < LEVELS[-1]).any():
        return None
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # few maps wait for it
    from matplotlib.figure import Figure

    figure = Figure(figsize=(size / DPI, size / DPI), dpi=DPI, facecolor="none")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    _draw(axes, chance)
    axes.set_xlim(-1, 1)
    axes.set_ylim(-1, 1)
    pixels, (width, height) = FigureCanvasAgg(figure).print_to_buffer()  # type: ignore[no-untyped-call]  # no types
    return np.frombuffer(bytes(pixels), dtype=np.uint8).reshape(height, width, 4)


def _draw(axes: Axes, chance: Floats) -> None:
    axis = (np.arange(len(chance)) + 0.5) / len(chance) * 2 - 1
    shown = np.ma.masked_invalid(chance)
    with_ends = (-1.0, *LEVELS, 2.0)
    hatched = axes.contourf(axis, -axis, shown, levels=with_ends, colors="none", hatches=list(HATCHES))
    hatched.set_edgecolor((0.0, 0.0, 0.0, 0.55))
    hatched.set_linewidth(0.0)
    for width, colour in ((3.4, "white"), (1.5, "black")):
        axes.contour(axis, -axis, shown, levels=LEVELS, colors=colour, linestyles=STYLES, linewidths=width)


def chance_legend(canvas: Canvas, candidates: Candidates, y: float) -> float:
    """What lines and hatching mean; nothing without chances. Returns where the next line may stand."""
    if touch_nothing(candidates) is None:
        return y
    canvas.write(side_pixels(0.0, y + 0.034), "chance to touch nothing forbidden", HEAD, anchor="lm")
    text = (f"< {LEVELS[0]:g}", *(f"{low:g}–{high:g}" for low, high in pairwise(LEVELS)), f"> {LEVELS[-1]:g}")
    for place, (name, hatch) in enumerate(zip(text, HATCHES, strict=True)):
        x = 0.25 * place
        box = (*side_pixels(x, y + 0.05), *side_pixels(x + 0.07, y + 0.078))
        canvas.rectangle(box, PALE, 0.8 * POINT)
        _hatch(canvas, box, hatch)
        canvas.write(side_pixels(x + 0.08, y + 0.064), name, NAME, anchor="lm")
        if place < len(LEVELS):
            line = np.array([side_pixels(x + 0.235, y + 0.05), side_pixels(x + 0.235, y + 0.078)])
            canvas.line(line, 1.5 * POINT, BLACK, dashes=DASHES[place])
    return y + 0.065


def _hatch(canvas: Canvas, box: tuple[float, float, float, float], hatch: str) -> None:
    """What a hatching looks like, in a box: its lines upwards, downwards, or dots."""
    left, top, right, bottom = box
    high, part = bottom - top, Canvas(round(right - left), round(bottom - top), None)
    offsets = np.arange(-high, right - left, SPACING)
    upward = np.stack(
        [np.stack([offsets, np.full_like(offsets, high)], -1), np.stack([offsets + high, 0 * offsets], -1)], 1
    )
    if set(hatch) & {"/", "x"}:
        part.segments(upward, 1.0, BLACK, opacity=0.7)
    if "x" in hatch:
        part.segments(upward * (1, -1) + (0, high), 1.0, BLACK, opacity=0.7)
    if "." in hatch:
        dots = np.stack(np.meshgrid(np.arange(5, right - left, 10), np.arange(5, high, 9)), -1).reshape(-1, 1, 2)
        part.segments(np.repeat(dots, 2, axis=1), 3.0, BLACK, opacity=0.7)
    canvas.paste(part.pixels, round(left), round(top))


def mark_dot(canvas: Canvas, place: Any) -> None:
    """A direction of the Pareto front."""
    canvas.segments(np.array([[place, place]]), 3.5 * POINT, BLACK)
    canvas.segments(np.array([[place, place]]), 2.5 * POINT, WHITE)


def mark_ring(canvas: Canvas, place: Any) -> None:
    """The best of a window."""
    canvas.line(circle(place, 3.4 * POINT), 1.2 * POINT, BLACK)


def mark_star(canvas: Canvas, place: Any, radius: float) -> None:
    """The chosen direction."""
    canvas.fill(star(place, radius), WHITE)
    canvas.line(star(place, radius), 1.6 * POINT, BLACK)
