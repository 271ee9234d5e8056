"""Pictures as sample grids with depth, and how opaque and translucent things come together in pixels."""

from __future__ import annotations

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
    """Opaque surfaces as a camera sees them, in the sample grid.

    Attributes:
        colour: Shape (h, w, 3), 0..255.
        depth: Shape (h, w), mm along the ray, infinite where nothing was hit.
    """

    colour: Floats32
    depth: Floats32

    def part(self, where: tuple[slice, slice]) -> RasterShot:
        """Rows and columns of it."""
        return RasterShot(self.colour[where], self.depth[where])


@dataclass(frozen=True, eq=False)
class Shells:
    """See-through surfaces, the nearest of every sample first.

    Attributes:
        colour: Shape (k, h, w, 3), 0..255.
        alpha: Shape (k, h, w), opacity, 0..1.
        depth: Shape (k, h, w), mm along the ray, infinite where there is none.
    """

    colour: Floats32
    alpha: Floats32
    depth: Floats32

    @staticmethod
    def empty(count: int, height: int, width: int) -> Shells:
        """Shells with nothing in them; the size is in samples."""
        size = (count, height, width)
        return Shells(
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


NOWHERE = PixelBox(0, 0, 0, 0)


def compose(shot: RasterShot, shells: Shells) -> NDArray[np.uint8]:
    """Blend see-through shells over the opaque shot and average the samples to pixels, shape (h, w, 3).

    The "over" operator of Porter and Duff, Compositing Digital Images (SIGGRAPH 1984), from back to front.

    Args:
        shells: Drawn where they lie before the opaque part.
    """
    height, width = shot.depth.shape
    pixels = np.empty((height // SAMPLES, width // SAMPLES, 3), dtype=np.uint8)
    nothing = np.full((height, width), np.nan, dtype=np.float32)
    recompose(pixels, shot, shells, nothing, PixelBox(0, 0, width, height))
    return pixels


def recompose(pixels: NDArray[np.uint8], shot: RasterShot, shells: Shells, before: Floats32, box: PixelBox) -> None:
    """Make those pixels of a picture anew, in place, that show something else than they did.

    Args:
        pixels: Shape (h, w, 3), what `compose` made of the same shells and another shot.
        before: Shape of ``shot.depth``, its depths then; a sample of the same depth shows the same.
        box: The part in which something may have changed, in samples.
    """
    columns = box.x0 // SAMPLES, -(-box.x1 // SAMPLES)
    rows = box.y0 // SAMPLES, -(-box.y1 // SAMPLES)
    _blend(pixels, shot.colour, shot.depth, shells.colour, shells.alpha, shells.depth, before, (*columns, *rows))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _blend(pixels, colour, depth, shell_colour, shell_alpha, shell_depth, before, box):  # type: ignore[no-untyped-def]  # numba infers
    """Shells over what lies behind them, sample by sample, and the rounded means of squares of samples."""
    left, right, top, bottom = box
    for i in range(top, bottom):
        for j in range(left, right):
            same = True
            for a in range(SAMPLES):
                for b in range(SAMPLES):
                    r, c = i * SAMPLES + a, j * SAMPLES + b
                    same = same and depth[r, c] == before[r, c]
            if same:
                continue
            red, green, blue = 0.0, 0.0, 0.0
            for a in range(SAMPLES):
                for b in range(SAMPLES):
                    r, c = i * SAMPLES + a, j * SAMPLES + b
                    x, y, z = colour[r, c, 0], colour[r, c, 1], colour[r, c, 2]
                    for k in range(len(shell_depth) - 1, -1, -1):
                        if shell_depth[k, r, c] < depth[r, c]:
                            alpha = shell_alpha[k, r, c]
                            x += alpha * (shell_colour[k, r, c, 0] - x)
                            y += alpha * (shell_colour[k, r, c, 1] - y)
                            z += alpha * (shell_colour[k, r, c, 2] - z)
                    red, green, blue = red + x, green + y, blue + z
            pixels[i, j, 0], pixels[i, j, 1], pixels[i, j, 2] = byte(red), byte(green), byte(blue)


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def byte(total):  # type: ignore[no-untyped-def]  # numba infers
    """The mean of a pixel's samples as a byte."""
    return np.uint8(min(max(np.round(total / SAMPLES**2), 0.0), 255.0))
