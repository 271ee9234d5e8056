"""Flat pictures by matplotlib, without pyplot and its state: a figure of so many pixels, its pixels, and its PNG.

What has coordinates is drawn so; words on pictures of pixels (scenes, films) are those of `annotate`, in the same font.
"""

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.reasons import Rgb, css
from puncture_twin.twin.report.palette import PNG_LEVEL

PIXEL_DPI = 72  # at so many dots an inch a printer's point is a pixel: sizes of letters and lines are in pixels


def figure_of(width: int, height: int, *, dpi: int = PIXEL_DPI, ground: str = "white") -> Figure:
    """An empty figure of a size in pixels; ``ground`` may be "none"."""
    figure = Figure(figsize=(width / dpi, height / dpi), dpi=dpi, facecolor=ground)
    FigureCanvasAgg(figure)
    return figure


def halo(width: float, colour: str = "white") -> list[Any]:
    """Path effects: a rim behind words or under a line, whose width, points, is that of line and rim together."""
    return [withStroke(linewidth=width, foreground=colour)]


def picture_axes(figure: Figure, image: NDArray[np.uint8]) -> Axes:
    """Axes in pixels (right, down; 0 is the upper left corner) of an image, (h, w) or (h, w, 3), that fills them."""
    axes, (h, w) = figure.add_axes((0, 0, 1, 1)), image.shape[:2]
    axes.set_axis_off()
    axes.imshow(image, cmap="gray", vmin=0, vmax=255, extent=(0, w, h, 0), interpolation="lanczos", aspect="auto")
    axes.set_autoscale_on(False)
    return axes


def ring(axes: Axes, at: Any, radius: float, colour: Rgb, text: str = "", width: float = 2.0) -> None:
    """A ring of so many pixels about a point, with words beside it."""
    axes.plot(*at, "o", ms=2 * radius, mfc="none", mec=css(colour), mew=width)
    look: dict[str, Any] = {"color": css(colour), "fontsize": 15, "va": "center", "path_effects": halo(3)}
    axes.annotate(text, at, (radius + 4, 0), textcoords="offset points", **look)


def cross(axes: Axes, at: Any, size: float, colour: Rgb, shape: str = "+") -> None:
    """A cross of so many pixels to each side."""
    axes.plot(*at, shape, ms=2 * size, mec=css(colour), mew=2)


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
