"""A sheet of small slices about points: each in the axial plane and along the body, with a cross and its name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.report.annotate import FAINT, write, write_image
from puncture_twin.twin.report.palette import SKIN
from puncture_twin.twin.report.slices.panel import TONES
from puncture_twin.twin.report.slices.planes import BACK, HEAD, LEFT, Plane, outline

TILE, GAP, CAPTION, ACROSS = 220, 10, 40, 3
"""Pixels of a slice, between slices, and of a caption; points side by side."""
CROSS, ARM = (3, 9), 2
"""Pixels from the point at which its cross begins and ends, and its width."""
YELLOW: Rgb = (255, 211, 77)
WITHOUT_CT: Rgb = (44, 47, 54)


class Mark(NamedTuple):
    """A point (3,), LPS mm, its name, and a line about it."""

    name: str
    point_ct: Floats
    line: str


def write_points_sheet(
    path: Path,
    title: str,
    points: Sequence[Mark],
    hu_at: Callable[[Floats], Floats] | None,
    skin: TriangleMesh,
    half_mm: float,
) -> Path:
    """Write the sheet; it appears whole or not at all.

    Args:
        hu_at: Hounsfield units at points (n, 3), NaN outside of the image; None without a CT.
    """
    rows = -(-len(points) // ACROSS)
    width, height = 2 * TILE + GAP, TILE + CAPTION + GAP
    across = min(ACROSS, len(points))
    sheet = Image.new("RGB", (max(640, GAP + across * (width + 2 * GAP)), 70 + rows * height), (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    write(draw, (GAP, 8), title, size=18, bold=True)
    under = "Left: axial, the patient's right on the left. Right: sagittal, the back to the right."
    under += f" Each {2 * half_mm:g} mm wide. Lines: the skin."
    write(draw, (GAP, 36), under, size=13, colour=FAINT)
    for number, one in enumerate(points):
        left, top = GAP + (number % ACROSS) * (width + 2 * GAP), 64 + (number // ACROSS) * height
        write(draw, (left, top), one.name, size=15, bold=True)
        write(draw, (left, top + 19), one.line, size=12, colour=FAINT)
        for column, (right, up) in enumerate(((LEFT, -BACK), (BACK, HEAD))):
            plane = Plane(one.name, one.point_ct, right, up, np.zeros(2), half_mm)
            sheet.paste(_tile(plane, hu_at, skin), (left + column * (TILE + GAP), top + CAPTION))
    write_image(sheet, path)
    return path


def _tile(plane: Plane, hu_at: Callable[[Floats], Floats] | None, skin: TriangleMesh) -> Image.Image:
    tile = Image.new("RGB", (TILE, TILE), WITHOUT_CT)
    if hu_at is not None:
        tile = Image.fromarray(TONES["bone"].grey(hu_at(plane.points_ct(TILE)).reshape(TILE, TILE))).convert("RGB")
    draw, middle = ImageDraw.Draw(tile), TILE / 2
    for a, b in outline(skin, plane) * [1.0, -1.0] * middle / plane.half_mm + middle:
        draw.line([*a, *b], fill=SKIN, width=1)
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        near, far = ((middle + x * away, middle + y * away) for away in CROSS)
        draw.line([near, far], fill=YELLOW, width=ARM)
    return tile
