"""Pictures as sample grids with depth, and how opaque things and veils come together in pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats32 = NDArray[np.float32]

SAMPLES = 2
"""Samples per pixel side."""

SAMPLES_AT_ONCE = 40_000
"""Work is done in bands of about so many samples: arrays of that size stay in the cache."""


@dataclass(frozen=True, eq=False)
class Shot:
    """What a camera saw of opaque things, in the sample grid.

    Attributes:
        colour: Shape (h, w, 3), 0..255.
        depth: Shape (h, w), mm along the ray, infinite where nothing was hit.
    """

    colour: Floats32
    depth: Floats32


@dataclass(frozen=True, eq=False)
class Veil:
    """One see-through layer: colour, opacity and depth per sample."""

    colour: Floats32
    alpha: Floats32
    depth: Floats32


def empty_veil(size: tuple[int, int]) -> Veil:
    """A veil with nothing in it, of a height and width in samples."""
    return Veil(
        np.zeros((*size, 3), dtype=np.float32),
        np.zeros(size, dtype=np.float32),
        np.full(size, np.inf, dtype=np.float32),
    )


class PixelBox(NamedTuple):
    """Columns x0..x1 and rows y0..y1 (ends excluded) of a picture."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def empty(self) -> bool:
        """Whether it holds no pixel."""
        return self.x1 <= self.x0 or self.y1 <= self.y0

    @property
    def slices(self) -> tuple[slice, slice]:
        """To index an image."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)

    def around(self, other: PixelBox) -> PixelBox:
        """The least box that holds both."""
        if self.empty or other.empty:
            return other if self.empty else self
        return PixelBox(min(self.x0, other.x0), min(self.y0, other.y0), max(self.x1, other.x1), max(self.y1, other.y1))


NOWHERE = PixelBox(0, 0, 0, 0)


def compose(shot: Shot, veils: Sequence[Veil], box: PixelBox | None = None) -> NDArray[np.uint8]:
    """Blend the veils over the opaque shot and average the samples to pixels, shape (h, w, 3).

    The "over" operator of Porter and Duff, Compositing Digital Images (SIGGRAPH 1984), from back to front.

    Args:
        shot: The opaque part, in the sample grid.
        veils: The shells of ``veils_of``, nearest first; each is drawn where it lies before the opaque part.
        box: The part to make, in samples, whole pixels; all of it when None.
    """
    height, width = shot.depth.shape
    box = box or PixelBox(0, 0, width, height)
    size = (box.y1 - box.y0) // SAMPLES, (box.x1 - box.x0) // SAMPLES
    pixels = np.empty((*size, 3), dtype=np.uint8)
    rows = max(1, SAMPLES_AT_ONCE // (size[1] * SAMPLES**2))
    for top in range(0, size[0], rows):
        bottom = min(top + rows, size[0])
        part = slice(box.y0 + top * SAMPLES, box.y0 + bottom * SAMPLES), slice(box.x0, box.x1)
        colour = shot.colour[part]
        for veil in reversed(veils):
            alpha = np.where(veil.depth[part] < shot.depth[part], veil.alpha[part], np.float32(0))[..., None]
            colour = colour + alpha * (veil.colour[part] - colour)
        mean = colour.reshape(bottom - top, SAMPLES, size[1], SAMPLES, 3).mean(axis=(1, 3))
        pixels[top:bottom] = np.clip(np.round(mean), 0, 255)
    return pixels
