"""Hounsfield units along the needle, over a bar for each structure that it passes through."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from puncture_twin.planning.base.reasons import css
from puncture_twin.planning.search.along_path import BEYOND_SKIN_MM, Stretch, stretches
from puncture_twin.twin.report.palette import TARGET_POINT
from puncture_twin.twin.report.slices.panel import drawn
from puncture_twin.twin.report.slices.subject import Subject

WIDTH, HEIGHT, DPI = 976, 330, 96
STEP_MM = 0.5
BEYOND_TARGET_MM = 15.0
"""How far behind the target the units are shown: where a tip goes that is too deep."""

SHOWN_HU = (-1050.0, 500.0)
"""At least; denser samples widen it."""

BAR = 0.74
"""Height of a structure's bar, of its row."""

LEFT, RIGHT = 0.2, 0.985
"""Edges of the plot in the picture; names stand to the left."""


def draw_hu_plot(subject: Subject) -> Image.Image | None:
    """The picture; None in a case without CT, and for a direction without an entry."""
    parts = stretches(subject.anatomy, subject.case.target_ct, subject.outward_ct, subject.path_mm)
    if not parts:
        return None
    figure = Figure(figsize=(WIDTH / DPI, HEIGHT / DPI), dpi=DPI, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    shown = (name for part in reversed(parts) for name in part.structures)
    names = tuple(dict.fromkeys(name for name in shown if name in subject.colours))
    split = 0.14 + min(0.5, 0.062 * max(1, len(names)))
    units = figure.add_axes((LEFT, split + 0.02, RIGHT - LEFT, 0.96 - split))
    bars = figure.add_axes((LEFT, 0.14, RIGHT - LEFT, split - 0.14), sharex=units)
    _units(units, subject)
    _bars(bars, subject, parts, names)
    for axes in (units, bars):
        axes.axvline(0, color=css(TARGET_POINT), lw=1.4)
        axes.axvline(subject.path_mm, color="black", lw=1.0, ls="--")
    return drawn(canvas).convert("RGB")


def _units(axes: Axes, subject: Subject) -> None:
    depths = np.arange(-BEYOND_TARGET_MM, subject.path_mm + BEYOND_SKIN_MM, STEP_MM)
    hu = subject.anatomy.scan.hu_at(subject.case.target_ct + depths[:, None] * subject.outward_ct)
    axes.step(depths, hu, where="mid", color="0.15", lw=1.3)
    axes.set_xlim(depths[-1], depths[0])
    axes.set_ylim(SHOWN_HU[0], max(SHOWN_HU[1], 1.05 * float(np.nanmax(hu, initial=0.0))))
    axes.set_ylabel("HU", fontsize=9)
    axes.tick_params(labelsize=8, labelbottom=False)
    axes.grid(visible=True, color="0.9")
    for at, text in ((0.0, " target"), (subject.path_mm, " skin")):
        axes.text(at, 0.03, text, transform=axes.get_xaxis_transform(), fontsize=8.5, va="bottom")


def _bars(axes: Axes, subject: Subject, parts: tuple[Stretch, ...], names: tuple[str, ...]) -> None:
    for row, name in enumerate(names):
        spans = [(part.start_mm, part.end_mm - part.start_mm) for part in parts if name in part.structures]
        colour = css(subject.colours[name])
        axes.broken_barh(spans, (row - BAR / 2, BAR), facecolors=colour, edgecolors="black", linewidth=0.4)
    axes.set_yticks(range(len(names)), [name.replace("_", " ") for name in names], fontsize=8)
    axes.set_ylim(max(1, len(names)) - 0.4, -0.6)
    axes.set_xlabel("mm from the target along the needle (left: outside; right of the target: deeper)", fontsize=9)
    axes.tick_params(axis="x", labelsize=8)
