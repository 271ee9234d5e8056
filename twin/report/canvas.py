# mypy: disable-error-code="no-untyped-def"
"""A picture that one draws on: smooth lines, filled outlines, words with a halo, other pictures.

How much of each pixel a line covers, and colours laid over a picture by that; compiled, pixel by pixel.

Round numbers along an axis.

DejaVu Sans as matplotlib ships it, so that no system font is needed; matplotlib itself is not loaded for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.base.reasons import Rgb

Cover = NDArray[np.float32]

BLACK: Rgb = (0, 0, 0)
WHITE: Rgb = (255, 255, 255)


class Halo(NamedTuple):
    """A rim about words or under a line: its width on each side in pixels, and its colour."""

    width: float
    colour: Rgb = WHITE


class Words(NamedTuple):
    """How words look: height in pixels, face, colour, a rim behind them, and from line to line, of the height."""

    size: float
    face: Face = "plain"
    colour: Rgb = BLACK
    halo: Halo | None = None
    spacing: float = 1.2

    def width(self, text: str) -> float:
        """Of the longest line, pixels."""
        return max(font(self.size, self.face).getlength(line) for line in text.split("\n"))


class Canvas:
    """A picture; columns and rows are counted from its upper left corner, the first pixel's middle is (0.5, 0.5).

    Args:
        width: Pixels.
        height: Pixels.
        ground: What it is filled with; None leaves it transparent.
    """

    def __init__(self, width: int, height: int, ground: Rgb | None = WHITE) -> None:
        self.pixels = np.zeros((height, width, 4), dtype=np.uint8)
        if ground is not None:
            self.pixels[:] = (*ground, 255)

    @property
    def image(self) -> Image.Image:
        """As it looks, RGBA."""
        return Image.fromarray(self.pixels)

    def line(
        self,
        points: Floats,
        width: float,
        colour: Rgb,
        *,
        opacity: float = 1.0,
        dashes: tuple[float, float] | None = None,
        halo: Halo | None = None,
    ) -> None:
        """A line from point to point.

        Args:
            points: Shape (n, 2): columns and rows.
            width: Pixels.
            colour: Of the line.
            opacity: Of the line.
            dashes: Pixels that are drawn, and pixels that are left out.
            halo: Under it.
        """
        points = np.asarray(points, dtype=float)
        parts = np.stack([points[:-1], points[1:]], axis=1) if dashes is None else dashed(points, width, *dashes)
        if halo is not None:
            self.segments(parts, width + 2 * halo.width, halo.colour, opacity=opacity)
        self.segments(parts, width, colour, opacity=opacity)

    def segments(self, segments: Floats, width: float, colour: Rgb, *, opacity: float = 1.0) -> None:
        """Lines from point to point, each alone, shape (n, 2, 2); where they cross nothing is darker."""
        if len(segments) == 0:
            return
        reach, segments = max(width, 1.0) / 2 + 1.0, np.asarray(segments, dtype=float)
        low, high = segments.min(axis=1) - reach, segments.max(axis=1) + reach
        segments = segments[(high >= 0).all(axis=1) & (low <= self.pixels.shape[1::-1]).all(axis=1)]
        if len(segments) == 0:  # all are beside the picture
            return
        corner, cover = self._part(segments.reshape(-1, 2), reach)
        if cover.size:
            cover_segments(cover, np.ascontiguousarray((segments - corner).reshape(-1, 4)), float(width))
            self._lay(cover, corner, colour, opacity)

    def fill(self, points: Floats, colour: Rgb, *, opacity: float = 1.0) -> None:
        """What a closed outline (n, 2) holds."""
        points = np.asarray(points, dtype=float)
        corner, cover = self._part(points, 1.0)
        if cover.size:
            cover_area(cover, np.ascontiguousarray(points - corner))
            self._lay(cover, corner, colour, opacity)

    def rectangle(
        self, box: tuple[float, float, float, float], ground: Rgb | None, edge: float = 0.0, colour: Rgb = BLACK
    ) -> None:
        """Left, top, right and bottom: filled, and with an edge so wide."""
        left, top, right, bottom = box
        corners = np.array([(left, top), (right, top), (right, bottom), (left, bottom), (left, top)])
        if ground is not None:
            self.fill(corners, ground)
        if edge > 0:
            self.line(corners, edge, colour)

    def write(self, at: tuple[float, float], text: str, look: Words, *, anchor: Anchor = "ls", turned: int = 0) -> None:
        """Words at a point, line below line about it where there are several.

        Args:
            at: Column and row.
            text: Lines.
            look: Of the letters.
            anchor: Which point of a line stands there, as Pillow names it.
            turned: Quarter turns counter-clockwise about the point; 1 or -1 read upwards or downwards.
        """
        lines = text.split("\n")
        masks = [_letters(line, look.size, look.face, anchor, 0.0) for line in lines]
        rims = [] if look.halo is None else [_letters(t, look.size, look.face, anchor, look.halo.width) for t in lines]
        first = -0.5 * (len(lines) - 1) * (anchor[1] == "m")
        shifts = [look.size * look.spacing * (first + i) for i in range(len(lines))]
        for rim, down in zip(rims, shifts, strict=False):
            assert look.halo is not None
            self._put(rim, at, down, look.halo.colour, turned)
        for mask, down in zip(masks, shifts, strict=True):
            self._put(mask, at, down, look.colour, turned)

    def paste(self, rgba: NDArray[np.uint8], left: int, top: int) -> None:
        """Lay another picture over this one, shape (h, w, 4); it lies within."""
        part = self.pixels[top : top + rgba.shape[0], left : left + rgba.shape[1]]
        under = Image.fromarray(np.ascontiguousarray(part))
        part[:] = np.asarray(Image.alpha_composite(under, Image.fromarray(rgba)))

    def _put(self, mask: _Mask, at: tuple[float, float], down: float, colour: Rgb, turned: int) -> None:
        (left, top), cover = mask
        top += down
        if turned:
            height, width = cover.shape
            left, top = (top, -left - width) if turned == 1 else (-top - height, left)
            cover = np.ascontiguousarray(np.rot90(cover, turned))
        self._lay(cover, (round(at[0] + left), round(at[1] + top)), colour, 1.0)

    def _part(self, points: Floats, reach: float) -> tuple[tuple[int, int], Cover]:
        """Corner (column, row) and nothing covered, of the part of the picture within a reach about points."""
        height, width = self.pixels.shape[:2]
        low = np.clip(np.floor(points.min(axis=0) - reach), 0, (width, height)).astype(int)
        high = np.clip(np.ceil(points.max(axis=0) + reach), low, (width, height)).astype(int)
        across, down = (high - low).tolist()
        return (int(low[0]), int(low[1])), np.zeros((down, across), dtype=np.float32)

    def _lay(self, cover: Cover, corner: tuple[int, int], colour: Rgb, opacity: float) -> None:
        """Lay a colour over what is covered, as far as it is in the picture."""
        height, width = self.pixels.shape[:2]
        (left, top), (down, across) = corner, cover.shape
        inside = cover[max(0, -top) : max(0, height - top), max(0, -left) : max(0, width - left)]
        part = self.pixels[max(0, top) : max(0, top + down), max(0, left) : max(0, left + across)]
        if inside.size:
            lay_over(part, np.ascontiguousarray(inside), tuple(float(c) for c in colour), opacity)


_Mask = tuple[tuple[float, float], Cover]
"""Left and top against the point where the words stand, and how much of each pixel they cover."""


def _cover(mask: Image.Image) -> Cover:
    return np.asarray(mask, dtype=np.float32) / np.float32(255)


def _letters(text: str, size: float, face: Face, anchor: Anchor, rim: float) -> _Mask:
    found = font(size, face)
    left, top, right, bottom = found.getbbox(text, anchor=anchor, stroke_width=rim)
    left, top = int(np.floor(left)) - 1, int(np.floor(top)) - 1
    mask = Image.new("L", (int(np.ceil(right)) - left + 1, int(np.ceil(bottom)) - top + 1))
    ImageDraw.Draw(mask).text((-left, -top), text, fill=255, font=found, anchor=anchor, stroke_width=rim)
    return (left, top), _cover(mask)


def rounded(box: tuple[float, float, float, float], radius: float) -> Floats:
    """A closed rectangle with round corners: left, top, right and bottom; shape (n, 2)."""
    left, top, right, bottom = box
    quarter = np.linspace(0.0, np.pi / 2, 9)
    arc = radius * np.stack([np.cos(quarter), np.sin(quarter)], axis=-1)
    corners = (
        ((right - radius, bottom - radius), arc),
        ((left + radius, bottom - radius), arc[::-1] * (-1, 1)),
        ((left + radius, top + radius), -arc),
        ((right - radius, top + radius), arc[::-1] * (1, -1)),
    )
    points = np.concatenate([np.asarray(centre) + bow for centre, bow in corners])
    return np.concatenate([points, points[:1]])


def circle(centre: Sequence[float], radius: float, corners: int = 48) -> Floats:
    """A closed line, shape (corners + 1, 2)."""
    turns = np.linspace(0.0, 2 * np.pi, corners + 1)
    return np.asarray(centre) + radius * np.stack([np.cos(turns), np.sin(turns)], axis=-1)


def star(centre: Sequence[float], radius: float) -> Floats:
    """A closed star with five points, the first at the top, shape (11, 2)."""
    turns = np.linspace(0.0, 2 * np.pi, 11)
    radii = radius * np.where(np.arange(11) % 2 == 0, 1.0, 0.381966)
    return np.asarray(centre) + radii[:, None] * np.stack([np.sin(turns), -np.cos(turns)], axis=-1)


LEAST_DASH = 0.05
"""Pixels between the middles of a dash's round ends: a dot."""


def dashed(points: Floats, width: float, drawn: float, left_out: float) -> Floats:
    """The parts of a line that are drawn.

    Args:
        points: Shape (n, 2), pixels.
        width: Of the line; its ends are round, which makes a dash longer by so much.
        drawn: Length of a dash, pixels.
        left_out: Between two dashes.

    Returns:
        Segments, shape (m, 2, 2).
    """
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    points, lengths = points[np.append(True, lengths > 0)], lengths[lengths > 0]
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    starts = np.arange(0.0, at[-1], drawn + left_out)
    ends = np.minimum(starts + max(drawn - width, LEAST_DASH), at[-1])
    breaks = np.unique(np.concatenate([at, starts, ends]))
    places = np.stack([np.interp(breaks, at, points[:, k]) for k in range(2)], axis=-1)
    middles = (breaks[1:] + breaks[:-1]) / 2
    dash = np.searchsorted(starts, middles, side="right") - 1
    inside = (dash >= 0) & (middles < ends[dash])
    return np.stack([places[:-1], places[1:]], axis=1)[inside]


LINES = 4
"""In a row of pixels, along which areas are filled."""


HALF_DIAGONAL = 0.7072
"""Of a pixel, rounded up."""


@nb.njit(nogil=True, error_model="numpy")
def _within(beyond, nx, ny):
    """The share of a pixel on one side of a line: exactly, the square's shadow on the normal is a trapezoid.

    Args:
        beyond: How far the line lies beyond the pixel's middle, along the normal.
        nx: Of the normal, of length 1.
        ny: Of it.
    """
    if beyond >= HALF_DIAGONAL:
        return 1.0
    long, short = max(abs(nx), abs(ny)), min(abs(nx), abs(ny))
    if short < 1e-6:
        return min(max(beyond / max(long, 0.5) + 0.5, 0.0), 1.0)
    far, near = 0.5 * (long + short), 0.5 * (long - short)
    corners = max(beyond + far, 0.0) ** 2 + max(beyond - far, 0.0) ** 2
    return (corners - max(beyond + near, 0.0) ** 2 - max(beyond - near, 0.0) ** 2) / (2.0 * long * short)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def cover_segments(cover, segments, width):
    """Draw segments with round ends; where several cover a pixel, the most counts.

    Args:
        cover: Shape (h, w), float32, 0..1; written to.
        segments: Shape (n, 4): column and row of both ends; (0, 0) is the upper left corner of the array.
        width: Pixels; below 1 a line is as wide as a pixel, and paler.
    """
    rows, columns = cover.shape
    half, most = 0.5 * max(width, 1.0), min(width, 1.0)
    reach = half + HALF_DIAGONAL
    for s in range(len(segments)):
        ax, ay, bx, by = segments[s, 0], segments[s, 1], segments[s, 2], segments[s, 3]
        dx, dy = bx - ax, by - ay
        length = np.sqrt(dx * dx + dy * dy)
        if length > 0.0:
            dx, dy = dx / length, dy / length
        for i in range(int(max(0.0, min(ay, by) - reach)), int(min(rows - 1.0, max(ay, by) + reach)) + 1):
            y = i + 0.5 - ay
            low, high = min(ax, bx) - reach, max(ax, bx) + reach
            if dy != 0.0:  # nearer than the reach to the endless line
                middle, aside = ax + y * dx / dy, reach / abs(dy)
                low, high = max(low, middle - aside), min(high, middle + aside)
            for j in range(int(max(0.0, low - 1.0)), int(min(columns - 1.0, high)) + 1):
                x = j + 0.5 - ax
                t = min(max(x * dx + y * dy, 0.0), length)
                nx, ny = x - t * dx, y - t * dy
                far = np.sqrt(nx * nx + ny * ny)
                if far > 0.0:
                    nx, ny = nx / far, ny / far
                else:
                    nx, ny = dy, dx
                value = most * (_within(half - far, nx, ny) - _within(-half - far, nx, ny))
                if value > cover[i, j]:
                    cover[i, j] = value


@nb.njit(cache=True, nogil=True, error_model="numpy")
def cover_area(cover, corners):
    """Fill what a closed outline holds: exactly along each of `LINES` lines in every row of pixels.

    Args:
        cover: Shape (h, w), float32, with nothing covered; written to.
        corners: Shape (n, 2), column and row; the last is joined to the first.
    """
    crossed = np.empty(len(corners))
    for i in range(cover.shape[0]):
        for line in range(LINES):
            y, count = i + (line + 0.5) / LINES, 0
            for k in range(len(corners)):
                ax, ay = corners[k - 1, 0], corners[k - 1, 1]
                bx, by = corners[k, 0], corners[k, 1]
                if (ay <= y) != (by <= y):
                    x, place = ax + (y - ay) / (by - ay) * (bx - ax), count
                    while place > 0 and crossed[place - 1] > x:
                        crossed[place] = crossed[place - 1]
                        place -= 1
                    crossed[place] = x
                    count += 1
            for k in range(0, count - 1, 2):
                left, right = max(crossed[k], 0.0), min(crossed[k + 1], float(cover.shape[1]))
                for j in range(int(left), int(np.ceil(right))):
                    cover[i, j] += max(0.0, min(j + 1.0, right) - max(float(j), left)) / LINES


@nb.njit(cache=True, nogil=True, error_model="numpy")
def lay_over(pixels, cover, colour, opacity):
    """Lay one colour over pixels, in place: the "over" operator of Porter and Duff (SIGGRAPH 1984).

    Args:
        pixels: Shape (h, w, 4), uint8: RGB and opacity.
        cover: Shape (h, w), float32, 0..1: how much of each pixel is covered.
        colour: Three numbers, 0..255.
        opacity: Of what covers, 0..1.
    """
    for i in range(cover.shape[0]):
        for j in range(cover.shape[1]):
            over = cover[i, j] * opacity
            if over <= 0.0:
                continue
            under = pixels[i, j, 3] / 255.0 * (1.0 - over)
            for k in range(3):
                pixels[i, j, k] = np.uint8(np.round((colour[k] * over + pixels[i, j, k] * under) / (over + under)))
            pixels[i, j, 3] = np.uint8(np.round(255.0 * (over + under)))


ROUND = (1.0, 2.0, 5.0, 10.0)


def ticks(low: float, high: float, most: int) -> Floats:
    """The multiples of 1, 2 or 5 times a power of ten in low..high: as many as fit, ``most`` steps at most."""
    rough = (high - low) / most
    power = 10.0 ** np.floor(np.log10(rough))
    step = next(power * factor for factor in ROUND if power * factor >= rough * (1 - 1e-9))
    first, last = round(np.ceil(low / step - 1e-9)), round(np.floor(high / step + 1e-9))
    return np.asarray(step * np.arange(first, last + 1))


Face = Literal["plain", "bold", "slanted"]

Anchor = Literal["lm", "rm", "mm", "la", "ra", "ma", "lb", "mb", "ls", "rs", "ms"]
"""Which point of a line of text stands at its place, as Pillow names it."""


@cache
def font(size: float, face: Face = "plain") -> ImageFont.FreeTypeFont:
    """A font of a height in pixels."""
    suffix = {"plain": "", "bold": "-Bold", "slanted": "-Oblique"}[face]
    return ImageFont.truetype(str(_folder() / f"DejaVuSans{suffix}.ttf"), size)


@cache
def _folder() -> Path:
    found = find_spec("matplotlib")
    assert found is not None and found.origin is not None, "matplotlib is not installed"
    return Path(found.origin).parent / "mpl-data" / "fonts" / "ttf"
