"""Rows of different lengths one behind another, and points by axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints

Axes = tuple[Floats, Floats, Floats]


def row_starts(sizes: Sequence[int] | Ints) -> Ints:
    """Where each row begins, and where the last ends, shape (n + 1,), of rows of given lengths."""
    return np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)]).astype(np.int64)


def by_axes(points: Floats) -> Axes:
    """The coordinates of points (n, 3), an array each."""
    x, y, z = (np.ascontiguousarray(axis) for axis in points.T)
    return x, y, z
