"""Hounsfield units along the needle, over a bar for each structure that it passes through."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from PIL import Image

from puncture_twin.planning.base.reasons import css
from puncture_twin.planning.search.bending import BEYOND_SKIN_MM, Stretch, stretches
from puncture_twin.twin.report.figures import figure_of, pixels
from puncture_twin.twin.report.palette import TARGET_POINT
from puncture_twin.twin.report.slices.subject import Subject

WIDTH, HEIGHT = 976, 330
STEP_MM = 0.5
BEYOND_TARGET_MM = 15.0
"""How far behind the target the units are shown: where a tip goes that is too deep."""

SHOWN_HU = (-1050.0, 500.0)
"""At least; denser samples widen it."""

BAR = 0.74
"""Height of a structure's bar, of its row."""

LEFT, RIGHT, BOTTOM, TOP, BETWEEN = 0.2, 0.985, 0.14, 0.98, 0.02
"""Edges of the plot in the picture, names stand to the left; and what lies between the units and the bars."""

ROW, MOST_BARS = 20.5 / HEIGHT, 0.5
"""Of the picture: height of a structure's row, and of all of them together at most."""

LETTERS, LEAST_LETTERS = 11.0, 8.0
"""Pixels: names of many structures are smaller."""


def draw_hu_plot(subject: Subject) -> Image.Image | None:
    """The picture; None in a case without CT, and for a direction without an entry."""
    parts = stretches(subject.anatomy, subject.case.target_ct, subject.outward_ct, subject.path_mm)
    if not parts:
        return None
    shown = (name for part in reversed(parts) for name in part.structures)
    names = tuple(dict.fromkeys(name for name in shown if name in subject.colours))
    row = min(ROW, MOST_BARS / max(1, len(names)))
    split = BOTTOM + row * max(1, len(names))
    figure = figure_of(WIDTH, HEIGHT)
    units = figure.add_axes((LEFT, split + BETWEEN, RIGHT - LEFT, TOP - split - BETWEEN))
    bars = figure.add_axes((LEFT, BOTTOM, RIGHT - LEFT, split - BOTTOM), sharex=units)
    _units(units, subject)
    _bars(bars, subject, parts, names, min(LETTERS, max(LEAST_LETTERS, BAR * row * HEIGHT)))
    for axes in (units, bars):
        axes.axvline(0.0, color=css(TARGET_POINT), linewidth=1.9)
        axes.axvline(subject.path_mm, color="black", linewidth=1.3, linestyle="--")
    return Image.fromarray(pixels(figure)).convert("RGB")


def _units(axes: Axes, subject: Subject) -> None:
    """A step a sample; nothing where the image has ended."""
    depths = np.arange(-BEYOND_TARGET_MM, subject.path_mm + BEYOND_SKIN_MM, STEP_MM)
    hu = subject.anatomy.scan.hu_at(subject.case.target_ct + depths[:, None] * subject.outward_ct)
    axes.step(depths, hu, where="mid", color="0.15", linewidth=1.7)
    axes.set_xlim(depths[-1], depths[0])
    axes.set_ylim(SHOWN_HU[0], max(SHOWN_HU[1], 1.05 * np.nanmax(hu, initial=0.0)))
    axes.set_ylabel("HU", fontsize=LETTERS + 1)
    axes.tick_params(labelsize=LETTERS, labelbottom=False, length=0)
    axes.grid(visible=True, color="0.9")
    for mm, text in ((0.0, "target"), (subject.path_mm, "skin")):
        axes.annotate(text, (mm, SHOWN_HU[0]), (5, 6), textcoords="offset points", fontsize=LETTERS)


def _bars(axes: Axes, subject: Subject, parts: tuple[Stretch, ...], names: tuple[str, ...], letters: float) -> None:
    """A row for each structure that the needle passes, with a bar where it is in it."""
    for row, name in enumerate(names):
        inside = [(part.start_mm, part.end_mm - part.start_mm) for part in parts if name in part.structures]
        colour = css(subject.colours[name])
        axes.broken_barh(inside, (row - BAR / 2, BAR), facecolors=colour, edgecolors="black", linewidths=0.6)
    axes.set_yticks(range(len(names)), [name.replace("_", " ") for name in names], fontsize=letters)
    axes.set_ylim(max(1, len(names)) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.tick_params(axis="x", labelsize=LETTERS)
    text = "mm from the target along the needle (left: outside; right of the target: deeper)"
    axes.set_xlabel(text, fontsize=LETTERS + 1)
