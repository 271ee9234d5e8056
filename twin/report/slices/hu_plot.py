"""Hounsfield units along the needle, over a bar for each structure that it passes through."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from PIL import Image

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.planning.search.bending import BEYOND_SKIN_MM, Stretch, stretches
from puncture_twin.twin.report.canvas import BLACK, Canvas, Words, ticks
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

LEFT, RIGHT = 0.2 * WIDTH, 0.985 * WIDTH
"""Edges of the plot in the picture; names stand to the left."""

TOP, BOTTOM, BETWEEN = 7.0, 284.0, 7.0
"""Pixels: upper edge of the units, lower edge of the bars, and what lies between both."""

ROW, LEAST_ROW, MOST_BARS = 20.5, 8.0, 165.0
"""Pixels: height of a structure's row; of many, and of all of them together."""

INK: Rgb = (38, 38, 38)
GRID: Rgb = (230, 230, 230)
SMALL, AXIS = Words(11), Words(12)


class _Frame(NamedTuple):
    """Where the plot lies: its upper and lower edge in pixels, and what they and the two sides stand for."""

    top: float
    bottom: float
    across: tuple[float, float]
    upward: tuple[float, float]

    def x(self, mm: float | Floats) -> Floats:
        """Columns of depths."""
        first, last = self.across
        return np.asarray(LEFT + (np.asarray(mm) - first) / (last - first) * (RIGHT - LEFT))

    def y(self, value: float | Floats) -> Floats:
        """Rows of values."""
        low, high = self.upward
        return np.asarray(self.bottom - (np.asarray(value) - low) / (high - low) * (self.bottom - self.top))


def draw_hu_plot(subject: Subject) -> Image.Image | None:
    """The picture; None in a case without CT, and for a direction without an entry."""
    parts = stretches(subject.anatomy, subject.case.target_ct, subject.outward_ct, subject.path_mm)
    if not parts:
        return None
    shown = (name for part in reversed(parts) for name in part.structures)
    names = tuple(dict.fromkeys(name for name in shown if name in subject.colours))
    split = BOTTOM - min(MOST_BARS, ROW * max(1, len(names)))
    depths = np.arange(-BEYOND_TARGET_MM, subject.path_mm + BEYOND_SKIN_MM, STEP_MM)
    hu = subject.anatomy.scan.hu_at(subject.case.target_ct + depths[:, None] * subject.outward_ct)
    across = float(depths[-1]), float(depths[0])
    units = _Frame(TOP, split - BETWEEN, across, (SHOWN_HU[0], max(SHOWN_HU[1], 1.05 * np.nanmax(hu, initial=0.0))))
    bars = _Frame(split, BOTTOM, across, (max(1, len(names)) - 0.5, -0.5))
    canvas = Canvas(WIDTH, HEIGHT)
    _grid(canvas, units, bars)
    _units(canvas, units, depths, hu)
    _bars(canvas, bars, subject, parts, names)
    for frame in (units, bars):
        _mark(canvas, frame, subject.path_mm)
        canvas.rectangle((LEFT, frame.top, RIGHT, frame.bottom), None, 1.0)
    for mm, text in ((0.0, "target"), (subject.path_mm, "skin")):
        canvas.write((float(units.x(mm)) + 5, units.bottom - 9), text, SMALL)
    return canvas.image.convert("RGB")


def _grid(canvas: Canvas, units: _Frame, bars: _Frame) -> None:
    """Lines at round numbers, with the numbers, and what they are."""
    for value in ticks(*units.upward, most=8).tolist():
        row = float(units.y(value))
        canvas.line(np.array([(LEFT, row), (RIGHT, row)]), 1.0, GRID)
        canvas.write((LEFT - 7, row), _said(value), SMALL, anchor="rm")
    for mm in ticks(units.across[1], units.across[0], most=8).tolist():
        column = float(units.x(mm))
        canvas.line(np.array([(column, units.top), (column, units.bottom)]), 1.0, GRID)
        canvas.line(np.array([(column, bars.bottom), (column, bars.bottom + 5)]), 1.0, BLACK)
        canvas.write((column, bars.bottom + 8), _said(mm), SMALL, anchor="ma")
    text = "mm from the target along the needle (left: outside; right of the target: deeper)"
    canvas.write(((LEFT + RIGHT) / 2, HEIGHT - 8), text, AXIS, anchor="ms")
    canvas.write((LEFT - 58, (units.top + units.bottom) / 2), "HU", AXIS, anchor="mm", turned=1)


def _said(value: float) -> str:
    return f"{value:.0f}".replace("-", "−")


def _units(canvas: Canvas, frame: _Frame, depths: Floats, hu: Floats) -> None:
    """A step a sample; nothing where the image has ended."""
    edges = frame.x(np.append(depths, depths[-1] + STEP_MM) - STEP_MM / 2)
    rows = frame.y(hu)
    points = np.stack([np.repeat(edges, 2)[1:-1], np.repeat(rows, 2)], axis=-1)
    points[:, 0] = np.clip(points[:, 0], LEFT, RIGHT)
    segments = np.stack([points[:-1], points[1:]], axis=1)
    canvas.segments(segments[np.isfinite(segments).all(axis=(1, 2))], 1.7, INK)


def _bars(canvas: Canvas, frame: _Frame, subject: Subject, parts: tuple[Stretch, ...], names: tuple[str, ...]) -> None:
    for row, name in enumerate(names):
        top, bottom = frame.y(np.array([row - BAR / 2, row + BAR / 2])).tolist()
        for part in (part for part in parts if name in part.structures):
            left, right = np.clip(frame.x(np.array([part.end_mm, part.start_mm])), LEFT, RIGHT).tolist()
            canvas.rectangle((left, top, right, bottom), subject.colours[name], 0.6)
        size = min(SMALL.size, max(LEAST_ROW, bottom - top))
        canvas.write((LEFT - 7, (top + bottom) / 2), name.replace("_", " "), Words(size), anchor="rm")


def _mark(canvas: Canvas, frame: _Frame, path_mm: float) -> None:
    """Where target and skin are."""
    target, skin = (float(frame.x(mm)) for mm in (0.0, path_mm))
    canvas.line(np.array([(target, frame.top), (target, frame.bottom)]), 1.9, TARGET_POINT)
    canvas.line(np.array([(skin, frame.top), (skin, frame.bottom)]), 1.3, BLACK, dashes=(5.0, 2.2))
