"""``slices.png``: slices of a direction and the units along its needle, or of an image; small ones about points."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from PIL import Image, ImageDraw

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import Rgb, css
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.search.bending import BEYOND_SKIN_MM, Stretch, stretches
from puncture_twin.twin.report.annotate import FAINT, legend, write, write_image
from puncture_twin.twin.report.figures import figure_of, pixels
from puncture_twin.twin.report.numbers import target_text
from puncture_twin.twin.report.palette import NEEDLE_COLOUR, REGION_COLOUR, SKIN, TARGET_POINT
from puncture_twin.twin.report.present import number
from puncture_twin.twin.report.slices import planes
from puncture_twin.twin.report.slices.panel import PIXELS, TONES, Panel, Subject, Tone, draw_panel, leaning

WITHOUT_CT: Rgb = (44, 47, 54)  # behind the outlines of a case without CT
NO_CT = "The case has no CT: only the outlines of the structures."
RADIOLOGICAL = "The patient's right is on the left. Each slice shows only its own plane: look at all of them."
GAP, TOP, CAPTION = 16, 92, 50
TILE, BETWEEN_TILES, HEAD_OF_TILE, ACROSS = 220, 10, 40, 3  # pixels of a slice, between, of a caption; points a row
CROSS, ARM = (3, 9), 2  # pixels from the point at which its cross begins and ends, and its width
YELLOW: Rgb = (255, 211, 77)
SIDES = ((planes.LEFT, -planes.BACK), (planes.BACK, planes.HEAD))  # right and up of both slices
HuAt = Callable[[Floats], Floats]  # HU at points (n, 3), NaN outside


@dataclass(frozen=True, eq=False)
class Slices:
    """Four slices of a direction, three of an image alone; the units along the needle where there is a CT."""

    subject: Subject
    panels: tuple[Panel, ...]
    units: Image.Image | None

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what the lines mean, and on what is missing."""
        subject = self.subject
        ct = NO_CT if subject.anatomy.scan is None else "The CT's nearest voxels, not smoothed."
        unknown = any(str(one.role) == "unknown" for one in subject.anatomy.checked)
        beads = " Beads: the edge of what is unknown." if unknown else ""
        if subject.pick is None:
            return ct, f"Lines: the skin and the structures.{beads}"
        dashed = f"; dashed: with the greatest margin near it, {number(subject.margin_mm, 1, 'mm')}"
        needle = subject.case.needle
        shown = f"Needle ⌀ {needle.diameter_mm:g} mm as thick as it is{dashed if subject.margin_mm > 0 else ''}"
        region = "" if subject.region_ct is None else "; pink: cut of the 95 % region of the tip"
        dotted = f"Of a needle that crosses a plane its cut alone is drawn.{beads}"
        bends = "" if subject.bent_mm is None else "Lime: range of bending by the bevel, to either side."
        return tuple(filter(None, (ct, f"{shown}{region}.", bends, dotted)))

    @property
    def legend(self) -> list[tuple[str, Rgb]]:
        """Names of the legend with their colours."""
        subject = self.subject
        target = subject.case.target_structure
        needle = [] if subject.pick is None else [("needle", NEEDLE_COLOUR)]
        first = [*needle, ("target", TARGET_POINT)]
        region = [] if subject.region_ct is None else [("95 % region", REGION_COLOUR)]
        named = [*((one.text, one.colour) for one in subject.named), *subject.beside]
        return [*first, *region, (target, subject.colours[target]), *named]


def draw_slices(subject: Subject) -> Slices:
    """The slices of one direction, or of the image alone."""
    target = subject.case.target_ct
    if subject.pick is None:
        shown = planes.body_planes(target, subject.anatomy.skin.mesh.bounds)
    else:
        shown = planes.needle_planes(target, subject.outward_ct, subject.path_mm)
    units = None if subject.pick is None else _hu_plot(subject)
    return Slices(subject, tuple(draw_panel(subject, plane) for plane in shown), units)


UNITS_SIZE = (976, 330)  # pixels: the plot of the units along the needle
STEP_MM = 0.5
BEYOND_TARGET_MM = 15.0  # how far behind the target the units are shown: where a tip goes that is too deep
SHOWN_HU = (-1050.0, 500.0)  # at least; denser samples widen it
BAR = 0.74  # height of a structure's bar, of its row
LEFT, RIGHT, BOTTOM, UPPER, BETWEEN = 0.2, 0.985, 0.14, 0.98, 0.02
"""Edges of the plot in the picture, names stand to the left; and what lies between the units and the bars."""

ROW, MOST_BARS = 20.5 / UNITS_SIZE[1], 0.5  # of the picture: a structure's row, and all together at most
LETTERS, LEAST_LETTERS = 11.0, 8.0  # pixels: names of many structures are smaller


def _hu_plot(subject: Subject) -> Image.Image | None:
    """Plot of Hounsfield units along the needle; None in a case without CT, and for a direction without an entry."""
    parts = stretches(subject.anatomy, subject.case.target_ct, subject.outward_ct, subject.path_mm)
    if not parts:
        return None
    shown = (name for part in reversed(parts) for name in part.structures)
    names = tuple(dict.fromkeys(name for name in shown if name in subject.colours))
    row = min(ROW, MOST_BARS / max(1, len(names)))
    split = BOTTOM + row * max(1, len(names))
    figure = figure_of(*UNITS_SIZE)
    units = figure.add_axes((LEFT, split + BETWEEN, RIGHT - LEFT, UPPER - split - BETWEEN))
    bars = figure.add_axes((LEFT, BOTTOM, RIGHT - LEFT, split - BOTTOM), sharex=units)
    _units(units, subject)
    _bars(bars, subject, parts, names, min(LETTERS, max(LEAST_LETTERS, BAR * row * UNITS_SIZE[1])))
    for axes in (units, bars):
        axes.axvline(0.0, color=css(TARGET_POINT), linewidth=1.9)
        axes.axvline(subject.path_mm, color="black", linewidth=1.3, linestyle="--")
    return Image.fromarray(pixels(figure)).convert("RGB")


def _units(axes: Axes, subject: Subject) -> None:
    depths = np.arange(-BEYOND_TARGET_MM, subject.path_mm + BEYOND_SKIN_MM, STEP_MM)
    hu = subject.anatomy.scan.hu_at(subject.case.target_ct + depths[:, None] * subject.outward_ct)
    axes.step(depths, hu, where="mid", color="0.15", linewidth=1.7)
    axes.set(xlim=(depths[-1], depths[0]), ylim=(SHOWN_HU[0], max(SHOWN_HU[1], 1.05 * np.nanmax(hu, initial=0.0))))
    axes.set_ylabel("HU", fontsize=LETTERS + 1)
    axes.tick_params(labelsize=LETTERS, labelbottom=False, length=0)
    axes.grid(visible=True, color="0.9")
    for mm, text in ((0.0, "target"), (subject.path_mm, "skin")):
        axes.annotate(text, (mm, SHOWN_HU[0]), (5, 6), textcoords="offset points", fontsize=LETTERS)


def _bars(axes: Axes, subject: Subject, parts: tuple[Stretch, ...], names: tuple[str, ...], letters: float) -> None:
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


def flat(panel: Panel, tone: Tone) -> Image.Image:
    """The slice with its overlay in one window, RGB."""
    ground = Image.new("RGBA", (PIXELS, PIXELS), (*WITHOUT_CT, 255))
    if panel.hu is not None:
        ground = Image.fromarray(tone.grey(panel.hu)).convert("RGBA")
    return Image.alpha_composite(ground, Image.fromarray(panel.overlay)).convert("RGB")


def write_sheet(slices: Slices, path: Path) -> None:
    """Write the sheet; it appears whole or not at all."""
    tone, subject, bottom = "abdomen", slices.subject, TOP + 2 * (PIXELS + CAPTION + GAP)
    units = 0 if slices.units is None else slices.units.height + GAP
    size = (3 * GAP + 2 * PIXELS, bottom + units + 150)
    sheet = Image.new("RGB", size, (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    write(draw, (GAP, 12), f"{subject.case.name}: {target_text(subject.case)}, {subject.title}", size=20, bold=True)
    level, width = TONES[tone]
    window = "" if subject.anatomy.scan is None else f"CT window {tone}: level {level:g}, width {width:g} HU. "
    write(draw, (GAP, 40), f"{window}{RADIOLOGICAL}", size=14, colour=FAINT)
    write(draw, (GAP, 62), "Research software, not a medical device.", size=14, colour=FAINT)
    for i, panel in enumerate(slices.panels):
        left, top = GAP + (i % 2) * (PIXELS + GAP), TOP + (i // 2) * (PIXELS + CAPTION + GAP)
        write(draw, (left, top), panel.plane.name, size=16, bold=True)
        write(draw, (left, top + 22), leaning(subject, panel.plane), size=13, colour=FAINT)
        sheet.paste(flat(panel, TONES[tone]), (left, top + CAPTION - 6))
    if slices.units is not None:
        sheet.paste(slices.units, (GAP, bottom))
    row = legend(draw, slices.legend, GAP, bottom + units, size[0] - GAP)
    for line in slices.notes:
        write(draw, (GAP, row), line, size=14, colour=FAINT)
        row += 20
    sheet = sheet.crop((0, 0, size[0], min(size[1], int(row) + GAP)))
    write_image(sheet, path)


class Mark(NamedTuple):
    """A point (3,), LPS mm, its name, and a line about it."""

    name: str
    point_ct: Floats
    line: str


def write_points_sheet(
    path: Path, title: str, points: Sequence[Mark], hu_at: HuAt | None, skin: TriangleMesh, half_mm: float
) -> Path:
    """Write the sheet, whole or not at all; `hu_at` is None without a CT."""
    rows = -(-len(points) // ACROSS)
    width, height = 2 * TILE + BETWEEN_TILES, TILE + HEAD_OF_TILE + BETWEEN_TILES
    across = min(ACROSS, len(points))
    sheet = Image.new(
        "RGB", (max(640, BETWEEN_TILES + across * (width + 2 * BETWEEN_TILES)), 70 + rows * height), (255, 255, 255)
    )
    draw = ImageDraw.Draw(sheet)
    write(draw, (BETWEEN_TILES, 8), title, size=18, bold=True)
    under = "Left: axial, the patient's right on the left. Right: sagittal, the back to the right."
    under += f" Each {2 * half_mm:g} mm wide. Lines: the skin."
    write(draw, (BETWEEN_TILES, 36), under, size=13, colour=FAINT)
    for place, one in enumerate(points):
        left, top = BETWEEN_TILES + (place % ACROSS) * (width + 2 * BETWEEN_TILES), 64 + (place // ACROSS) * height
        write(draw, (left, top), one.name, size=15, bold=True)
        write(draw, (left, top + 19), one.line, size=12, colour=FAINT)
        for column, (right, up) in enumerate(SIDES):
            plane = planes.Plane(one.name, one.point_ct, right, up, np.zeros(2), half_mm)
            sheet.paste(_tile(plane, hu_at, skin), (left + column * (TILE + BETWEEN_TILES), top + HEAD_OF_TILE))
    write_image(sheet, path)
    return path


def _tile(plane: planes.Plane, hu_at: HuAt | None, skin: TriangleMesh) -> Image.Image:
    tile = Image.new("RGB", (TILE, TILE), WITHOUT_CT)
    if hu_at is not None:
        tile = Image.fromarray(TONES["bone"].grey(hu_at(plane.points_ct(TILE)).reshape(TILE, TILE))).convert("RGB")
    draw, middle = ImageDraw.Draw(tile), TILE / 2
    for a, b in planes.outline(skin, plane) * [1.0, -1.0] * middle / plane.half_mm + middle:
        draw.line([*a, *b], fill=SKIN, width=1)
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        near, far = ((middle + x * away, middle + y * away) for away in CROSS)
        draw.line([near, far], fill=YELLOW, width=ARM)
    return tile
