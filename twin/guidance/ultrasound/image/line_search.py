"""The brightest straight segment of a picture: a Radon transform that may begin and end anywhere.

Every line of a grid of angles and offsets is sampled; along it the segment with the largest sum is found in one pass
(Kadane's maximum subarray, Bentley, Commun. ACM 27, 1984). What a sample must exceed to lengthen the segment is
subtracted before, so that noise has a falling sum and the largest one stays small where there is no needle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb


class Segment(NamedTuple):
    """A straight segment, in pixels of the picture that was searched."""

    start: Floats
    """(column, row) of the shallower end."""
    end: Floats
    """(column, row) of the deeper end."""
    score: float
    """Sum of the samples along it, one per pixel of length."""


def brightest_segment(field: Floats, inclinations: Floats) -> Segment:
    """The segment of the largest sum.

    Args:
        field: Shape (rows, columns): what a sample adds; below zero on average where there is nothing.
        inclinations: Shape (n,), rad: directions of lines to try, atan2(dv, du), in (0, pi): from shallow to deep.
    """
    best = _search(np.ascontiguousarray(field), np.ascontiguousarray(inclinations))
    return Segment(np.array(best[1:3]), np.array(best[3:5]), float(best[0]))


@nb.njit(cache=True)
def _search(field, inclinations):  # type: ignore[no-untyped-def]
    rows, columns = field.shape
    middle_x, middle_y = 0.5 * (columns - 1), 0.5 * (rows - 1)
    half = math.ceil(0.5 * math.hypot(rows, columns))
    best = (0.0, 0.0, 0.0, 0.0, 0.0)
    for angle in inclinations:
        dx, dy = math.cos(angle), math.sin(angle)
        for offset in range(-half, half + 1):
            x0, y0 = middle_x - offset * dy, middle_y + offset * dx
            total, begin = 0.0, -half
            for step in range(-half, half + 1):
                x, y = x0 + step * dx, y0 + step * dy
                if x < 0.0 or y < 0.0 or x >= columns - 1 or y >= rows - 1:
                    continue
                i, j = int(x), int(y)
                a, b = x - i, y - j
                top = (1.0 - a) * field[j, i] + a * field[j, i + 1]
                low = (1.0 - a) * field[j + 1, i] + a * field[j + 1, i + 1]
                if total <= 0.0:
                    total, begin = 0.0, step
                total += (1.0 - b) * top + b * low
                if total > best[0]:
                    best = (total, x0 + begin * dx, y0 + begin * dy, x, y)
    return best
