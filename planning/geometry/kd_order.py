"""An order of points in which every aligned run of 2^j leaves is a box of a k-d tree, and nothing is stored."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.numba_kernels import nb

STACK = 128
"""Ranges that wait while a part is split: one per level, and 2^64 points have 64 levels."""


def kd_order(points: NDArray[np.float64], leaf: int) -> NDArray[np.int64]:
    """Sort points so that runs of ``leaf``, and aligned runs of 2, 4, 8 ... such runs, are compact.

    Each range is split across its longest side; the left part takes the largest ``leaf * 2^j`` below the whole, so the
    runs stay aligned whatever the count.

    Args:
        points: Shape (n, 3), finite.
        leaf: Points in a run, at least 1.

    Returns:
        Shape (n,), row numbers in their new order.
    """
    records = np.array(points, dtype=np.float32, order="C")
    order = np.arange(len(points))
    _sort(records, order, leaf)
    return order


@nb.njit(cache=True, nogil=True)
def _sort(records, order, leaf):  # type: ignore[no-untyped-def]  # numba infers
    """Split range after range, each at its left-balanced middle."""
    stack = np.empty((STACK, 2), np.int64)
    stack[0, 0], stack[0, 1] = 0, len(records)
    waiting = 1
    while waiting > 0:
        waiting -= 1
        low, high = stack[waiting, 0], stack[waiting, 1]
        count = high - low
        if count <= leaf:
            continue
        left = leaf
        while 2 * left < count:
            left *= 2
        _select(records, order, low, high, low + left, _longest_side(records, low, high))
        stack[waiting, 0], stack[waiting, 1] = low, low + left
        stack[waiting + 1, 0], stack[waiting + 1, 1] = low + left, high
        waiting += 2


@nb.njit(cache=True, nogil=True)
def _longest_side(records, low, high):  # type: ignore[no-untyped-def]  # numba infers
    """Axis along which a range of points extends most."""
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
def _select(records, order, low, high, middle, axis):  # type: ignore[no-untyped-def]  # numba infers
    """Rearrange a range until no point before ``middle`` lies above one behind it (Hoare's selection)."""
    high -= 1
    while low < high:
        a, b, c = records[low, axis], records[(low + high) // 2, axis], records[high, axis]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = low, high
        while i <= j:
            while records[i, axis] < pivot:
                i += 1
            while records[j, axis] > pivot:
                j -= 1
            if i <= j:
                for k in range(3):
                    records[i, k], records[j, k] = records[j, k], records[i, k]
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return
