"""PNG files (ISO/IEC 15948): a picture's bytes packed as they are, or as differences from the pixel to the left.

Pillow tries all five filters of the format on every row, which takes as long as packing. Of flat colours none is
smallest; of shaded surfaces the differences are.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.files import atomic

SIGNATURE = b"\x89PNG\r\n\x1a\n"
COLOUR_TYPES = {3: 2, 4: 6}
"""Of pixels of three bytes and of four."""

AS_THEY_ARE, TO_THE_LEFT = 0, 1
"""Filters."""

FLAT_LEVEL, SHADED_LEVEL = 3, 2
"""How hard rows are packed: from the next level on it takes half as long again, for a few parts in a hundred."""


def write_png(pixels: NDArray[np.uint8], path: Path, *, shaded: bool = False) -> None:
    """Write a picture, whole or not at all; arguments as of `png_bytes`."""
    with atomic(path) as temporary:
        temporary.write_bytes(png_bytes(pixels, shaded=shaded))


def png_bytes(pixels: NDArray[np.uint8], *, shaded: bool = False) -> bytes:
    """A picture as the bytes of a file.

    Args:
        pixels: Shape (h, w, 3), RGB, or (h, w, 4), RGB and opacity.
        shaded: Whether most of it is shaded, not in flat colours.
    """
    height, width, channels = pixels.shape
    head = struct.pack(">IIBBBBB", width, height, 8, COLOUR_TYPES[channels], 0, 0, 0)
    rows = zlib.compress(_filtered(pixels, shaded=shaded).data, SHADED_LEVEL if shaded else FLAT_LEVEL)
    return SIGNATURE + _chunk(b"IHDR", head) + _chunk(b"IDAT", rows) + _chunk(b"IEND", b"")


def _filtered(pixels: NDArray[np.uint8], *, shaded: bool) -> NDArray[np.uint8]:
    """Rows with their filter before them, shape (h, 1 + bytes of a row)."""
    height, width, channels = pixels.shape
    plain = pixels.reshape(height, width * channels)
    rows = np.empty((height, 1 + width * channels), dtype=np.uint8)
    rows[:, 0] = TO_THE_LEFT if shaded else AS_THEY_ARE
    rows[:, 1:] = plain
    if shaded:
        rows[:, 1 + channels :] -= plain[:, :-channels]
    return rows


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
