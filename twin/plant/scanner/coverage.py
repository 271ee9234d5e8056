"""Partial volumes: solids cut by many lines along the voxels' rows, and each line's pieces measured exactly.

Every slice is cut by some planes and every row by some lines. A plane cuts a closed surface in closed chains of
segments, and a line cuts these in crossings; both by half-open intervals, of which neighbours share the end, so that
nothing leaks through an edge or a corner. A point is inside a solid where its winding number is not 0; where solids
overlap, the later one fills the place.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb

LINE_MM = 0.3
"""Lines and planes are at most so far apart: volumes of organs then agree with their surfaces' to 1e-4."""
LEAST_LINES = 3
"""Lines a row and planes a slice, however small: an odd number, so that one of them runs through the centres."""


class Cut(NamedTuple):
    """Mean value of each voxel (nx, ny, nz), and (layers, nx, ny, nz) the label at its centre; 0 for nothing."""

    values: NDArray[np.float32]  # shape (nx, ny, nz), float32, the mean over each voxel
    labels: NDArray[Any]


def cut_solids(
    corners: Floats, owners: NDArray[np.int64], fills: Floats, labels: NDArray[Any], shape: tuple[int, int, int], *,
    spacing_mm: Floats, empty: float,
) -> Cut:  # fmt: skip
    """Mean of what fills each voxel of a grid, and the label at its centre.

    Triangles of all solids, corners (m, 3, 3) in voxels (centres are whole), belong to their owners (m,). Solids are
    filled (n,), later ones in the place of earlier ones, and labelled (layers, n) in each map, 0 where it does not show
    them; ``empty`` is where no solid is. The voxels' spacing (3,) says how many lines there are.
    """
    nx, ny, nz = shape
    lines, planes = (max(LEAST_LINES, 2 * int(np.ceil(mm / LINE_MM / 2)) + 1) for mm in spacing_mm[1:])
    values = np.empty((nz, ny, nx), np.float32)
    marks = np.zeros((len(labels), nz, ny, nx), labels.dtype)
    starts, members = _of_slices(corners, nz)
    for k in range(nz):
        some = members[starts[k] : starts[k + 1]]
        _slice(corners[some], owners[some], fills, labels, (k, lines, planes), empty, values[k], marks[:, k])
    return Cut(values.transpose(2, 1, 0), marks.transpose(0, 3, 2, 1))


def _of_slices(corners: Floats, count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangles that reach into each slice: starts (count + 1,) in one list of their numbers."""
    low = np.clip(np.ceil(corners[:, :, 2].min(axis=1) - 0.5).astype(np.int64), 0, count)
    high = np.clip(np.floor(corners[:, :, 2].max(axis=1) + 0.5).astype(np.int64), -1, count - 1)
    spans = np.maximum(0, high - low + 1)
    triangle = np.repeat(np.arange(len(corners)), spans)
    slices = np.arange(len(triangle)) - np.repeat(np.cumsum(spans) - spans, spans) + low[triangle]  # low, low + 1 ...
    order = np.argsort(slices, kind="stable")
    return np.searchsorted(slices[order], np.arange(count + 1)), triangle[order]


@nb.njit(cache=True, nogil=True)
def _slice(corners, owners, fills, labels, cuts, empty, values, marks):  # type: ignore[no-untyped-def]  # numba infers
    ny, nx = values.shape
    k, subs, planes = cuts
    steps = np.zeros((ny, nx + 1))
    segments = np.empty((len(corners), 4))
    whose = np.empty(len(corners), np.int64)
    winding = np.zeros(len(fills), np.int64)
    for plane in range(planes):
        z = k + (plane + 0.5) / planes - 0.5
        count = _segments(corners, owners, z, segments, whose)
        within = (plane + 0.5) / planes  # lines of one plane lie between those of another: a face along them is hit
        starts, xs, turns = _crossings(segments[:count], whose[:count], ny, subs, within)
        for line in range(ny * subs):
            first, last = starts[line], starts[line + 1]
            if first == last:
                continue
            _sort(xs[first:last], turns[first:last])
            _add_line(xs[first:last], turns[first:last], fills, empty, winding, steps[line // subs])
            if plane == planes // 2 and line % subs == subs // 2:
                for layer in range(len(labels)):
                    row = marks[layer, line // subs]
                    _mark_line(xs[first:last], turns[first:last], labels[layer], winding, row)
    for j in range(ny):
        sum_ = 0.0
        for i in range(nx):
            sum_ += steps[j, i]
            values[j, i] = empty + sum_ / (subs * planes)


@nb.njit(cache=True, nogil=True)
def _segments(corners, owners, z, segments, whose):  # type: ignore[no-untyped-def]
    """Cuts of a plane with triangles: (x, y) from the edge that rises through it to the edge that falls."""
    count = 0
    for t in range(len(corners)):
        below = 0
        for c in range(3):
            below += corners[t, c, 2] <= z
        if below == 0 or below == 3:
            continue
        for c in range(3):
            a, b = corners[t, c], corners[t, (c + 1) % 3]
            if (a[2] <= z) == (b[2] <= z):
                continue
            rises = a[2] <= z
            low, high = (a, b) if rises else (b, a)
            part = (z - low[2]) / (high[2] - low[2])
            at = 0 if rises else 2
            segments[count, at] = low[0] + part * (high[0] - low[0])
            segments[count, at + 1] = low[1] + part * (high[1] - low[1])
        whose[count] = owners[t]
        count += 1
    return count


@nb.njit(cache=True, nogil=True)
def _crossings(segments, whose, ny, subs, within):  # type: ignore[no-untyped-def]
    """Crossings of a plane's lines with its segments, line by line; a turn is the solid's number + 1, with its sign."""
    lines = ny * subs
    starts = np.zeros(lines + 2, np.int64)
    for s in range(len(segments)):
        first, last = _lines_between(segments[s, 1], segments[s, 3], subs, within, lines)
        for line in range(first, last):
            starts[line + 2] += 1
    for line in range(lines):
        starts[line + 2] += starts[line + 1]
    xs, turns = np.empty(starts[lines + 1]), np.empty(starts[lines + 1], np.int64)
    for s in range(len(segments)):
        ax, ay, bx, by = segments[s]
        sign = 1 if by > ay else -1
        if sign < 0:
            ax, ay, bx, by = bx, by, ax, ay
        first, last = _lines_between(ay, by, subs, within, lines)
        for line in range(first, last):
            y = (line + within) / subs - 0.5
            xs[starts[line + 1]] = ax + (y - ay) / (by - ay) * (bx - ax)
            turns[starts[line + 1]] = sign * (whose[s] + 1)
            starts[line + 1] += 1
    return starts, xs, turns


@nb.njit(cache=True, nogil=True)
def _lines_between(a, b, subs, within, lines):  # type: ignore[no-untyped-def]
    """The first line above the lower end, and the first above the upper one."""
    low, high = min(a, b), max(a, b)
    first = min(max(0, int(np.floor((low + 0.5) * subs - within)) - 1), lines)
    while first < lines and (first + within) / subs - 0.5 <= low:
        first += 1
    last = first
    if high > low:
        last = min(max(first, int(np.floor((high + 0.5) * subs - within)) - 1), lines)
        while last < lines and (last + within) / subs - 0.5 <= high:
            last += 1
    return first, last


@nb.njit(cache=True, nogil=True)
def _sort(xs, turns):  # type: ignore[no-untyped-def]
    for i in range(1, len(xs)):
        x, turn, j = xs[i], turns[i], i - 1
        while j >= 0 and xs[j] > x:
            xs[j + 1], turns[j + 1] = xs[j], turns[j]
            j -= 1
        xs[j + 1], turns[j + 1] = x, turn


@nb.njit(cache=True, nogil=True)
def _topmost(top, solid, winding):  # type: ignore[no-untyped-def]
    if winding[solid] != 0:
        return max(top, solid)
    if solid == top:
        top -= 1
        while top >= 0 and winding[top] == 0:
            top -= 1
    return top


@nb.njit(cache=True, nogil=True)
def _add_line(xs, turns, fills, empty, winding, steps):  # type: ignore[no-untyped-def]
    """Add a line's jumps to a row: what jumps within a voxel fills the rest of it, and all voxels behind."""
    nx = len(steps) - 1
    top, value = -1, empty
    for e in range(len(xs)):
        solid = abs(turns[e]) - 1
        winding[solid] += 1 if turns[e] > 0 else -1
        top = _topmost(top, solid, winding)
        now = fills[top] if top >= 0 else empty
        if now != value and xs[e] < nx - 0.5:
            x = max(xs[e], -0.5)
            i = min(int(np.floor(x + 0.5)), nx - 1)
            into = x + 0.5 - i
            steps[i] += (now - value) * (1.0 - into)
            steps[i + 1] += (now - value) * into
        value = now
    winding[:] = 0  # of an open surface, what it left


@nb.njit(cache=True, nogil=True)
def _mark_line(xs, turns, labels, winding, marks):  # type: ignore[no-untyped-def]
    nx, top, begin = len(marks), -1, 0
    for e in range(len(xs)):
        solid = abs(turns[e]) - 1
        if labels[solid] == 0:
            continue
        end = min(max(0, int(np.ceil(xs[e]))), nx)
        if top >= 0:
            marks[begin:end] = labels[top]
        begin = end
        winding[solid] += 1 if turns[e] > 0 else -1
        top = _topmost(top, solid, winding)
    winding[:] = 0
