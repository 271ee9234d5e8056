"""Text on pixel pictures with Pillow, in matplotlib's own font: text with a rim, body axes, scale, legend."""

from functools import cache
from pathlib import Path
from typing import Literal

import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.twin.report.map_view import body_directions
from puncture_twin.twin.report.palette import PNG_LEVEL
from puncture_twin.twin.report.raster.camera import ViewCamera

INK: Rgb = (25, 27, 32)
FAINT: Rgb = (110, 114, 122)
WHITE: Rgb = (255, 255, 255)
RED: Rgb = (190, 0, 20)
SHORT_AXIS = 0.45  # of its length: an axis that appears shorter points at the viewer; labels would collide
LEGEND_SIZE = 15  # pixels: a legend's letters and patches
SCALE_BARS_MM = (5, 10, 20, 50, 100, 200, 500)
Place = tuple[float, float]  # right and down, pixels
Anchor = Literal["lm", "rm", "mm", "la", "ra", "ma", "lb", "mb", "ls", "rs", "ms"]
"""The point of a line of text that lies at its position, as Pillow names it."""


@cache
def font(size: float, bold: bool = False) -> ImageFont.FreeTypeFont:
    """A font of a height in pixels."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(mpl.get_data_path(), "fonts", "ttf", name)), size)


def write_image(image: Image.Image, path: Path) -> None:
    """Write a picture as a PNG; the file appears whole or not at all."""
    with atomic(Path(path)) as temporary:
        image.save(temporary, format="PNG", compress_level=PNG_LEVEL)


def write(
    draw: ImageDraw.ImageDraw,
    at: Place,
    text: str,
    *,
    size: int = 16,
    bold: bool = False,
    colour: Rgb = INK,
    anchor: Anchor = "la",
    halo: int = 0,
) -> None:
    """One line of text; ``halo`` is the width of a white rim in pixels."""
    draw.text(at, text, fill=colour, font=font(size, bold), anchor=anchor, stroke_width=halo, stroke_fill=WHITE)


def body_axes(
    draw: ImageDraw.ImageDraw, camera: ViewCamera, space: str, centre: Place, length: float, size: int = 15
) -> None:
    """A small cross of the body's directions in this view, far ends pale; one in its plane is `length` pixels long."""
    reach = length + 3.6 * size
    disc = [centre[0] - reach, centre[1] - reach, centre[0] + reach, centre[1] + reach]
    draw.ellipse(disc, fill=(250, 250, 252), outline=(200, 204, 210))
    toward, gap = camera.axes[2], 6  # pixels; words that stand nearer read as one
    taken: list[tuple[float, float, float, float]] = []
    ends = sorted(body_directions(space).items(), key=lambda item: -float(item[1] @ toward))
    for name, vector in ends:
        offset = np.array([vector @ camera.axes[0], -(vector @ camera.axes[1])])
        shown = float(np.linalg.norm(offset))
        far = vector @ toward > 0.02
        colour = FAINT if far else INK
        end = (centre[0] + length * offset[0], centre[1] + length * offset[1])
        draw.line([centre, end], fill=colour, width=2 if far else 3)
        if shown < SHORT_AXIS:
            continue
        out = offset / shown
        at = end[0] + out[0] * 6, end[1] + out[1] * (size * 0.75)
        short = name.removeprefix("patient's ")
        anchor: Anchor = "lm" if out[0] > 0.35 else "rm" if out[0] < -0.35 else "mm"
        box = draw.textbbox(at, short, font=font(size, not far), anchor=anchor)
        for side in (1, -1, 2, -2, 3, -3):  # beside words that already stand there: above them it would read as one
            if not any(
                box[0] < one[2] + gap and one[0] < box[2] + gap and box[1] < one[3] + gap and one[1] < box[3] + gap
                for one in taken
            ):
                break
            at = end[0] + side * size * 0.6, end[1]
            anchor = "lm" if side > 0 else "rm"
            box = draw.textbbox(at, short, font=font(size, not far), anchor=anchor)
        taken.append(box)
        write(draw, at, short, size=size, bold=not far, colour=colour, anchor=anchor, halo=2)


def scale_bar(
    draw: ImageDraw.ImageDraw,
    camera: ViewCamera,
    at_ct: Floats,
    left: float,
    bottom: float,
    width_px: float,
    note: str = " at the target's depth",
) -> None:
    """A bar of a round length, true at the depth of one point (3,), where nearer things look larger."""
    depth = float(camera.project(at_ct)[0, 2])
    per_mm = camera.scale / depth
    fitting = [mm for mm in SCALE_BARS_MM if mm * per_mm <= width_px]
    mm = fitting[-1] if fitting else SCALE_BARS_MM[0]
    right = left + mm * per_mm
    draw.line([(left, bottom), (right, bottom)], fill=INK, width=4)
    for x in (left, right):
        draw.line([(x, bottom - 6), (x, bottom + 6)], fill=INK, width=2)
    write(draw, (left, bottom - 22), f"{mm} mm{note}", size=14, halo=2)


def legend(draw: ImageDraw.ImageDraw, items: list[tuple[str, Rgb]], left: float, top: float, right: float) -> float:
    """Colour patches with names, line after line; returns the row below the last line."""
    x, y, size = left, top, LEGEND_SIZE
    for name, colour in items:
        text = name.replace("_", " ")
        need = size + 8 + float(font(size).getlength(text)) + 22
        if x + need > right and x > left:
            x, y = left, y + size + 11
        draw.rectangle([x, y, x + size, y + size], fill=colour, outline=INK)
        write(draw, (x + size + 8, y + size / 2 + 1), text, size=size, anchor="lm")
        x += need
    return y + size + 11


def panel(draw: ImageDraw.ImageDraw, box: tuple[int, int, int, int], title: str) -> None:
    """A frame around a view with its title in the upper left corner."""
    draw.rectangle(box, outline=(190, 194, 200), width=1)
    write(draw, (box[0] + 12, box[1] + 10), title, size=16, bold=True, halo=3)
