"""A map of directions for a notebook: θ is the radius, β the angle, counter-clockwise from the right.

What is mapped are cells, rectangles in (θ, β), each with a verdict. They are painted on bins of at least `FINEST`; a
bin takes the verdict that comes last in the legend's order among the cells that touch it, so that a legend from the
best to the most cautious never shows more as safe than is safe.
"""

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints, Pixels
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import atomic, check_writable
from puncture_twin.planning.base.reasons import Rgb, css
from puncture_twin.planning.base.text import escape

FINEST = np.radians(0.5)
"""rad: a smaller bin is smaller than a pixel at the rim."""
MOST_BINS = 720
"""Most bins around the circle, and from the pole to the rim."""
SLACK = 1e-6
"""Fraction of a bin by which rounding may move a cell's edge."""
SIZE = 320
"""Width and height on the page, CSS pixels; the picture is twice as fine."""
RING_DEG = 30.0
"""Degrees between two circles of equal θ."""
INK = 0.45
"""Opacity of circles and axes."""


class Sectors(NamedTuple):
    """n cells of directions: their edges and rows of the legend."""

    theta: Floats  # shape (n, 2), lowest and highest, rad
    beta: Floats  # shape (n, 2), lowest and highest, rad; from 0 on, at most a turn wide
    code: Ints  # shape (n,): row of the legend


class Entry(NamedTuple):
    """One line of the legend."""

    text: str
    colour: Rgb


@dataclass(frozen=True)
class PolarMap:
    """A map with its legend, for a notebook or a file."""

    png: bytes  # the picture; no bytes where nothing is mapped
    under: str  # below it, HTML: what is drawn, and a line for each verdict that occurs

    def _repr_html_(self) -> str:
        """HTML for a notebook; "" where nothing is mapped."""
        address = b64encode(self.png).decode("ascii")
        image = f'<img width="{SIZE}" height="{SIZE}" alt="Verdict by direction" src="data:image/png;base64,{address}">'
        return f"<div>{image}{self.under}</div>" if self.png else ""

    def write(self, path: Path | str) -> Path:
        """Write the picture, a PNG without the legend, whole. Raises InputError: nothing is mapped, or no place."""
        if not self.png:
            refuse("nothing is mapped", "plot_map", "a search with directions", "empty")
        path = Path(path)
        check_writable(path.parent)
        with atomic(path) as draft:
            draft.write_bytes(self.png)
        return path


NO_MAP = PolarMap(b"", "")


def polar_map(cells: Sectors, legend: Sequence[Entry], bin_rad: float = FINEST) -> PolarMap:
    """The map with its legend, of bins of this size, at least `FINEST`; empty without cells."""
    rim = float(cells.theta.max(initial=0.0))
    if rim <= 0.0:
        return NO_MAP
    bins = _painted(cells, rim, max(bin_rad, FINEST))
    lines = "".join(
        f'<div><span style="color:{css(entry.colour)};-webkit-text-stroke:.6px #5a616b">■</span> '
        f"{escape(entry.text)}</div>"
        for row, entry in enumerate(legend)
        if (bins == row).any()
    )
    reach = f"θ from 0 in the middle to {np.degrees(rim):g}° at the rim, a circle every {RING_DEG:g}°"
    from PIL import Image  # here: only a notebook shows it

    stream = BytesIO()
    Image.fromarray(_drawn(bins, legend, rim)).save(stream, format="PNG")
    return PolarMap(stream.getvalue(), f"<div>{reach}; β from the right, up</div>{lines}")


def _drawn(bins: Ints, legend: Sequence[Entry], rim: float) -> Pixels:
    """The bin at the middle of each pixel in its colour, circles and axes over it; white beyond, shape (n, n, 3)."""
    side = (np.arange(2 * SIZE) + 0.5) / SIZE - 1.0
    x, y = np.meshgrid(side, -side)
    radius, (rings, around) = np.hypot(x, y), bins.shape
    ring = np.minimum((radius * rings).astype(np.int64), rings - 1)
    sector = (np.mod(np.arctan2(y, x), 2 * np.pi) / (2 * np.pi) * around).astype(np.int64) % around
    colours = np.array([*(entry.colour for entry in legend), (255, 255, 255)], dtype=np.uint8)
    picture = colours[np.where(radius <= 1.0, bins[ring, sector], -1)]
    line_gap = np.abs(radius[..., None] - np.append(np.arange(0.0, np.degrees(rim), RING_DEG) / np.degrees(rim), 1.0))
    lined = (line_gap.min(axis=-1) < 0.5 / SIZE) | ((radius < 1.0) & (np.minimum(np.abs(x), np.abs(y)) < 0.5 / SIZE))
    picture[lined] = np.round(picture[lined] * (1.0 - INK))
    return np.asarray(picture)


def _painted(cells: Sectors, rim: float, size: float) -> Ints:
    """The row of the legend of every bin, shape (rings, bins around); -1 where no cell is."""
    rings = int(np.clip(round(rim / size), 1, MOST_BINS))
    around = int(np.clip(round(2 * np.pi / size), 8, MOST_BINS))
    bins = np.full((rings, around), -1, dtype=np.int64)
    t_first, t_last = _touched(cells.theta / rim * rings)
    b_first, b_last = _touched(cells.beta / (2 * np.pi) * around)
    for row in np.argsort(cells.code, kind="stable"):
        ring = slice(t_first[row], min(t_last[row], rings))
        sectors = np.arange(b_first[row], min(b_last[row], b_first[row] + around)) % around
        bins[ring, sectors] = cells.code[row]
    return bins


def _touched(edges: Floats) -> tuple[Ints, Ints]:
    """First bin, and the one after the last, that cells with these edges (n, 2) touch."""
    first = np.floor(edges[:, 0] + SLACK).astype(np.int64)
    return first, np.maximum(np.ceil(edges[:, 1] - SLACK).astype(np.int64), first + 1)
