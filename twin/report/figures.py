"""Flat pictures by matplotlib: a figure of so many pixels, its pixels, and the PNG that is the same for the same input.

A `Figure` on Agg, without pyplot and its state. What has coordinates is drawn so; words on pictures of pixels (scenes,
films, camera images) are those of `annotate`, in the same font.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from puncture_twin.planning.base.files import atomic
from puncture_twin.twin.report.palette import PNG_LEVEL

PIXEL_DPI = 72
"""At so many dots an inch a printer's point is a pixel: sizes of letters and lines are in pixels."""


def figure_of(width: int, height: int, *, dpi: int = PIXEL_DPI, ground: str = "white") -> Figure:
    """An empty figure of a size in pixels; ``ground`` may be "none"."""
    figure = Figure(figsize=(width / dpi, height / dpi), dpi=dpi, facecolor=ground)
    FigureCanvasAgg(figure)
    return figure


def halo(width: float, colour: str = "white") -> list[Any]:
    """Path effects: a rim behind words or under a line.

    Args:
        width: Of the rim on both sides together, and of the line itself, points.
        colour: Of the rim.
    """
    return [withStroke(linewidth=width, foreground=colour)]


def pixels(figure: Figure) -> NDArray[np.uint8]:
    """A figure's pixels, shape (h, w, 4), RGB and opacity."""
    buffer, (width, height) = FigureCanvasAgg(figure).print_to_buffer()  # type: ignore[no-untyped-call]  # no types
    return np.frombuffer(bytes(buffer), dtype=np.uint8).reshape(height, width, 4)


def png(figure: Figure) -> bytes:
    """A figure as a PNG, without a name of the program or a date."""
    FigureCanvasAgg(figure)
    held = BytesIO()
    figure.savefig(held, format="png", metadata={"Software": None}, pil_kwargs={"compress_level": PNG_LEVEL})
    return held.getvalue()


def write_png(figure: Figure, path: Path) -> None:
    """Write a figure; the file appears whole or not at all."""
    with atomic(Path(path)) as temporary:
        temporary.write_bytes(png(figure))
