"""The pixels whose centres a closed polygon winds around."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats


def polygon_fill(points: Floats, shape: tuple[int, int]) -> Bools:
    """Pixels inside a polygon; a channel of no width between two parts of it (a keyhole) encloses nothing.

    A centre is inside if the edges that a ray from it along the first axis crosses upward and downward differ in
    number: what is traced twice is inside still, where an odd count would leave it out. Each edge holds its lower end
    and not its upper one, so that a vertex is counted once.

    Args:
        points: Shape (n, 2), in pixels: (i, j) is the centre of a pixel. The last is joined to the first.
        shape: Of the image, (ni, nj); what lies outside of it is cut off.

    Returns:
        Shape (ni, nj).
    """
    ni, nj = shape
    start, end = points, np.roll(points, -1, axis=0)
    down = (start[:, 1] > end[:, 1])[:, None]
    low, high = np.where(down, end, start), np.where(down, start, end)
    first, last = (np.clip(np.ceil(one[:, 1]), 0, nj).astype(int) for one in (low, high))
    crossed = last - first
    edge = np.repeat(np.arange(len(points)), crossed)
    j = np.arange(len(edge)) - np.repeat(np.cumsum(crossed) - crossed - first, crossed)
    slope = (high[edge, 0] - low[edge, 0]) / (high[edge, 1] - low[edge, 1])
    i = np.clip(np.ceil(low[edge, 0] + (j - low[edge, 1]) * slope), 0, ni).astype(int)
    turn = np.where(down[edge, 0], -1.0, 1.0)
    crossings = np.bincount(i * nj + j, turn, minlength=(ni + 1) * nj).reshape(ni + 1, nj)
    return np.asarray(np.cumsum(crossings[:ni], axis=0) != 0)
