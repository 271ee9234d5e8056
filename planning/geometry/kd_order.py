"""An order of points in which every aligned run of 2^j leaves is a box of a k-d tree, and nothing is stored."""

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.numba_kernels import nb

STACK = 128
"""Ranges still to split: one per level, and 2^64 points have 64 levels."""
SAMPLED = 128
"""Points of a range for each one in the sample that a pivot is chosen from; the sample has three more."""
MOST_SAMPLED = 63
"""Largest sample: to sort more costs as much as the better pivot saves."""


def kd_order(points: NDArray[np.float64], leaf: int) -> NDArray[np.int64]:
    """Sort points so that runs of ``leaf``, and aligned runs of 2, 4, 8 ... such runs, are compact.

    Each range is split across its longest side; the left part takes the largest ``leaf * 2^j`` below the whole, so the
    runs stay aligned whatever the count.

    Args:
        points: Shape (n, 3), finite, n below 2^31.
        leaf: Points in a run, at least 1.

    Returns:
        Shape (n,), row numbers in their new order.
    """
    records = np.empty((len(points), 4), np.float32)
    records[:, :3] = points
    rows = records.view(np.int32)
    rows[:, 3] = np.arange(len(points))
    _sort(records, rows, leaf)
    return rows[:, 3].astype(np.int64)


@nb.njit(cache=True, nogil=True)
def _sort(records, rows, leaf):  # type: ignore[no-untyped-def]  # numba infers
    stack, sample = np.empty((STACK, 2), np.int64), np.empty(MOST_SAMPLED, np.float32)
    stack[0, 0], stack[0, 1] = 0, len(records)
    waiting = 1
    while waiting > 0:
        waiting -= 1
        low, high = stack[waiting, 0], stack[waiting, 1]
        count = high - low
        if count <= leaf:
            continue
        left = leaf
        while 2 * left < count:  # the left part is full, so its runs stay aligned
            left *= 2
        _select(records, rows, sample, low, high, low + left, _longest_side(records, low, high))
        stack[waiting, 0], stack[waiting, 1] = low, low + left
        stack[waiting + 1, 0], stack[waiting + 1, 1] = low + left, high
        waiting += 2


@nb.njit(cache=True, nogil=True)
def _longest_side(records, low, high):  # type: ignore[no-untyped-def]  # numba infers
    x0 = x1 = records[low, 0]
    y0 = y1 = records[low, 1]
    z0 = z1 = records[low, 2]
    for i in range(low + 1, high):
        x, y, z = records[i, 0], records[i, 1], records[i, 2]
        x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
        x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    dx, dy, dz = x1 - x0, y1 - y0, z1 - z0
    if dx >= dy and dx >= dz:
        return 0
    return 1 if dy >= dz else 2


@nb.njit(cache=True, nogil=True)
def _select(records, rows, sample, low, high, middle, axis):  # type: ignore[no-untyped-def]  # numba infers
    """Rearrange a range until no point before ``middle`` lies above one behind it.

    Quickselect whose pivot is where a sample expects the middle: the next range is short (Floyd and Rivest 1975).
    """
    while high - low > 1:
        pivot = _expected(records, sample, low, high, middle, axis)
        border = _part(records, rows, low, high, axis, pivot, False)
        if border == low:  # none lies below: those that equal the pivot come first
            border = _part(records, rows, low, high, axis, pivot, True)
            if middle <= border or border == low:  # not a number equals nothing, and has no order
                return
        if middle < border:
            high = border
        elif middle > border:
            low = border
        else:
            return


@nb.njit(cache=True, nogil=True)
def _expected(records, sample, low, high, middle, axis):  # type: ignore[no-untyped-def]  # numba infers
    """Median of a sample of a range, sorted by insertion: one of the range's own values."""
    many = min(MOST_SAMPLED, 3 + (high - low) // SAMPLED)
    step = (high - low) // many
    for k in range(many):
        value, place = records[low + k * step + step // 2, axis], k
        while place > 0 and sample[place - 1] > value:
            sample[place] = sample[place - 1]
            place -= 1
        sample[place] = value
    return sample[(middle - low) * many // (high - low)]


@nb.njit(cache=True, nogil=True)
def _part(records, rows, low, high, axis, pivot, equal):  # type: ignore[no-untyped-def]  # numba infers
    """Move what lies below a pivot, or equals it, to the front of a range; returns where the rest begins.

    Every record is swapped with the first of the rest, and only the border's step depends on its value: no branch is
    mispredicted. ``rows`` are the records as integers, so that copies keep their bits; unsigned indices need no test.
    """
    border = np.uint64(low)
    for i in range(np.uint64(low), np.uint64(high)):
        value = records[i, axis]
        x, y, z, row = rows[border, 0], rows[border, 1], rows[border, 2], rows[border, 3]
        rows[border, 0], rows[border, 1], rows[border, 2], rows[border, 3] = (
            rows[i, 0],
            rows[i, 1],
            rows[i, 2],
            rows[i, 3],
        )
        rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3] = x, y, z, row
        border += np.uint64(value < pivot or (equal and value == pivot))
    return np.int64(border)
