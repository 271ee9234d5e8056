"""Which structure forbids each region of the map, and where its name stands in it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from puncture_twin.planning.base.arrays import Bools, Floats, Ints, Texts
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.search.candidates import Verdict
from puncture_twin.twin.report.map.map_layout import POINT, RADIUS, Label

NAMED_FRACTION = 0.006
"""Least fraction of the disc that a rejected region needs to carry its structure's name."""

NOT_SEEN_HERE = "not seen"
"""In a region whose directions leave what was scanned; the legend says how."""

LETTER_HIGH, LETTER_WIDE = 0.7 * 9 * POINT, 0.29 * 9 * POINT
"""Pixels: half the room of a line and of a letter; no two names lie over one another while there is room."""

COARSE = 4
"""Every so manyth pixel is looked at to find a name's place."""


def region_codes(verdict: Verdict, rows: Ints) -> tuple[NDArray[np.int64], list[str]]:
    """What is written over each pixel, as its place in a list of names, of which the first is empty.

    Args:
        verdict: Of every direction.
        rows: Shape (n, n), the candidate under each pixel, -1 outside.
    """
    written = _region_names(verdict)
    names = ["", *sorted(set(written) - {""})]
    place = {name: i for i, name in enumerate(names)}
    codes = np.array([*map(place.__getitem__, written), 0])
    return codes[rows], names


def region_labels(codes: NDArray[np.int64], names: Sequence[str], written: Sequence[Label]) -> list[Label]:
    """The names of all large enough regions, deep inside them and off what is written there."""
    coarse = codes[::COARSE, ::COARSE]
    free = np.ones(coarse.shape, dtype=bool)
    for x, y, text in written:
        _take(free, *_pixel(x, y, len(coarse)), *_half_size(text, len(coarse)))
    labels = []
    for depth, structure in _regions(coarse, names):
        text = structure.replace("_", " ")
        high, wide = _half_size(text, len(coarse))
        space = np.where(ndimage.minimum_filter(free, (2 * high + 1, 2 * wide + 1)), depth, 0.0)
        row, column = np.unravel_index(int(np.where(space.any(), space, depth).argmax()), depth.shape)
        _take(free, int(row), int(column), high, wide)
        x, y = (column + 0.5) / len(coarse) * 2 - 1, 1 - (row + 0.5) / len(coarse) * 2
        labels.append(Label(float(x), float(y), text))
    return labels


def _region_names(verdict: Verdict) -> Texts:
    """What is written over each direction, shape (n,): the structure that forbids it, or "unknown" and why."""
    unknown = verdict.reason == Reason.UNKNOWN_REGION.value
    named = np.where(verdict.reason == Reason.TOO_CLOSE.value, verdict.structure, "").astype(object)
    whys = np.where(verdict.not_seen, NOT_SEEN_HERE, verdict.structure)
    named[unknown] = [f"unknown:\n{why}" for why in whys[unknown]]
    return np.asarray(named)


def _regions(codes: NDArray[np.int64], names: Sequence[str]) -> list[tuple[Floats, str]]:
    """Large enough regions of one name, the largest first: how deep inside each pixel lies, and the name."""
    found = []
    for code, name in enumerate(names):
        labels, _ = ndimage.label((codes == code) if name else np.zeros(codes.shape, dtype=bool))
        areas = np.bincount(labels.ravel())[1:]
        for part in np.flatnonzero(areas > NAMED_FRACTION * codes.size * np.pi / 4) + 1:
            depth = ndimage.distance_transform_edt(np.pad(labels == part, 1))[1:-1, 1:-1]
            found.append((float(areas[part - 1]), depth, name))
    return [(depth, name) for _, depth, name in sorted(found, key=lambda region: -region[0])]


def _half_size(text: str, size: int) -> tuple[int, int]:
    """Half the height and half the width of a name, in pixels of a square picture of the disc."""
    scale, lines = size / (2 * RADIUS), text.split("\n")
    return round(LETTER_HIGH * len(lines) * scale), round(LETTER_WIDE * max(map(len, lines)) * scale)


def _pixel(x: float, y: float, size: int) -> tuple[int, int]:
    """Row and column of a point of the disc (x right, y up) in a square picture of it."""
    return round((1 - y) / 2 * size), round((1 + x) / 2 * size)


def _take(free: Bools, row: int, column: int, high: int, wide: int) -> None:
    """Mark a name's box about a pixel, half so high and wide, in place."""
    free[max(0, row - high) : row + high + 1, max(0, column - wide) : column + wide + 1] = False
