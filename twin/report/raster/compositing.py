"""Pictures as sample grids with depth, and how opaque and translucent things come together in pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.numba_kernels import nb

Floats32 = NDArray[np.float32]

SAMPLES = 2
"""Samples per pixel side."""


@dataclass(frozen=True, eq=False)
class RasterShot:
    """What a camera saw of opaque things, in the sample grid.

    Attributes:
        colour: Shape (h, w, 3), 0..255.
        depth: Shape (h, w), mm along the ray, infinite where nothing was hit.
    """

    colour: Floats32
    depth: Floats32


@dataclass(frozen=True, eq=False)
class TranslucentLayer:
    """One see-through layer: colour, opacity and depth per sample."""

    colour: Floats32
    alpha: Floats32
    depth: Floats32


def empty_translucent(size: tuple[int, int]) -> TranslucentLayer:
    """A translucent layer with nothing in it, of a height and width in samples."""
    return TranslucentLayer(
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


def compose(
    shot: RasterShot, translucents: Sequence[TranslucentLayer], box: PixelBox | None = None
) -> NDArray[np.uint8]:
    """Blend the translucent layers over the opaque shot and average the samples to pixels, shape (h, w, 3).

    The "over" operator of Porter and Duff, Compositing Digital Images (SIGGRAPH 1984), from back to front.

    Args:
        shot: The opaque part, in the sample grid.
        translucents: The shells of ``translucents_of``, nearest first; drawn where they lie before the opaque part.
        box: The part to make, in samples, whole pixels; all of it when None.
    """
    height, width = shot.depth.shape
    part = (box or PixelBox(0, 0, width, height)).slices
    colour = shot.colour[part].copy()
    for translucent in reversed(translucents):
        _blend(colour, shot.depth[part], translucent.colour[part], translucent.alpha[part], translucent.depth[part])
    return np.asarray(_pixels(colour, SAMPLES))


@nb.njit(cache=True, nogil=True)
def _blend(colour, depth, translucent_colour, translucent_alpha, translucent_depth):  # type: ignore[no-untyped-def]  # numba infers
    """One translucent layer over what lies behind it, sample by sample, in place."""
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            if translucent_depth[i, j] < depth[i, j]:
                for k in range(3):
                    colour[i, j, k] += translucent_alpha[i, j] * (translucent_colour[i, j, k] - colour[i, j, k])


@nb.njit(cache=True, nogil=True)
def _pixels(colour, samples):  # type: ignore[no-untyped-def]  # numba infers
    """Means of squares of samples, rounded."""
    pixels = np.empty((colour.shape[0] // samples, colour.shape[1] // samples, 3), dtype=np.uint8)
    for i in range(pixels.shape[0]):
        for j in range(pixels.shape[1]):
            for k in range(3):
                total = 0.0
                for a in range(samples):
                    for b in range(samples):
                        total += colour[i * samples + a, j * samples + b, k]
                pixels[i, j, k] = np.uint8(min(max(np.round(total / samples**2), 0.0), 255.0))
    return pixels
