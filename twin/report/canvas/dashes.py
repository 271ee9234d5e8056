"""Lines in dashes and dots."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats

LEAST_DASH = 0.05
"""Pixels between the middles of a dash's round ends: a dot."""


def dashed(points: Floats, width: float, drawn: float, left_out: float) -> Floats:
    """The parts of a line that are drawn.

    Args:
        points: Shape (n, 2), pixels.
        width: Of the line; its ends are round, which makes a dash longer by so much.
        drawn: Length of a dash, pixels.
        left_out: Between two dashes.

    Returns:
        Segments, shape (m, 2, 2).
    """
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    points, lengths = points[np.append(True, lengths > 0)], lengths[lengths > 0]
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    starts = np.arange(0.0, at[-1], drawn + left_out)
    ends = np.minimum(starts + max(drawn - width, LEAST_DASH), at[-1])
    breaks = np.unique(np.concatenate([at, starts, ends]))
    places = np.stack([np.interp(breaks, at, points[:, k]) for k in range(2)], axis=-1)
    middles = (breaks[1:] + breaks[:-1]) / 2
    dash = np.searchsorted(starts, middles, side="right") - 1
    inside = (dash >= 0) & (middles < ends[dash])
    return np.stack([places[:-1], places[1:]], axis=1)[inside]
