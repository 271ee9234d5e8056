"""What of a mask holds together: pieces by runs along the last axis, which are few where voxels are many.

Lines along the last axis are cut into runs of True; runs of neighbouring lines that touch are joined (union-find, each
root the first run of its piece). Nothing as large as the mask is made but the masks that are wanted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Ints, Ints32
from puncture_twin.planning.base.numba_kernels import nb


class Pieces(NamedTuple):
    """The pieces of a mask, numbered by their first voxels.

    Attributes:
        shape: Of the mask, (ni, nj, nk).
        offsets: Shape (ni nj + 1,), where the runs of each line begin among all runs.
        runs: Shape (n, 2), the first voxel of a run, and the one after its last.
        number: Shape (n,), which piece each belongs to.
        count: How many pieces there are.
    """

    shape: tuple[int, ...]
    offsets: Ints
    runs: Ints32
    number: Ints
    count: int

    def sizes(self, where: Bools | None = None) -> Ints:
        """How many voxels each piece has, of those where a mask is True; shape (count,)."""
        if where is None:
            return np.bincount(self.number, self.runs[:, 1] - self.runs[:, 0], self.count).astype(np.int64)
        found = np.zeros(self.count, np.int64)
        _count(self.offsets, self.runs, self.number, lines(where), found)
        return found

    def mask(self, kept: Bools) -> Bools:
        """The voxels of some pieces, shape (count,)."""
        found = np.zeros(self.shape, bool)
        _fill(self.offsets, self.runs, kept[self.number], lines(found))
        return found


def pieces(mask: Bools, *, corners: bool) -> Pieces:
    """The pieces of a mask.

    Args:
        mask: Shape (ni, nj, nk).
        corners: Whether voxels that share an edge or a corner hold together, beside those that share a face.
    """
    rows = lines(mask)
    offsets = np.zeros(len(rows) + 1, np.int64)
    _count_runs(rows, offsets[1:])
    np.cumsum(offsets, out=offsets)
    runs = np.empty((offsets[-1], 2), np.int32)
    _find_runs(rows, offsets, runs)
    parent = np.arange(len(runs))
    _join(offsets, runs, mask.shape[1], int(corners), parent)
    roots = parent == np.arange(len(runs))
    number = (np.cumsum(roots) - 1)[parent]
    return Pieces(mask.shape, offsets, runs, number, int(np.count_nonzero(roots)))


def lines(mask: Bools) -> Bools:
    """The lines of a mask along its last axis, as kernels are compiled for them: shape (ni nj, nk)."""
    return np.require(mask, requirements=["C", "W"]).reshape(-1, mask.shape[-1])


@nb.njit(cache=True)
def _count_runs(rows, counts):  # type: ignore[no-untyped-def]  # numba infers
    """How many runs each line has."""
    for n in range(len(rows)):
        before = False
        count = 0
        for k in range(rows.shape[1]):
            count += rows[n, k] & (not before)
            before = rows[n, k]
        counts[n] = count


@nb.njit(cache=True)
def _find_runs(rows, offsets, runs):  # type: ignore[no-untyped-def]
    """First voxel, and the one after the last, of every run."""
    for n in range(len(rows)):
        at, before = offsets[n], False
        if at == offsets[n + 1]:
            continue
        for k in range(rows.shape[1]):
            if rows[n, k] != before:
                if before:
                    runs[at, 1] = k
                    at += 1
                else:
                    runs[at, 0] = k
                before = not before
        if before:
            runs[at, 1] = rows.shape[1]


@nb.njit(cache=True)
def _join(offsets, runs, nj, beside, parent):  # type: ignore[no-untyped-def]
    """Give each run the first one of its piece; ``beside`` is 1 where edges and corners count."""
    for n in range(len(offsets) - 1):
        j = n % nj
        for di, dj in ((1, -1), (1, 0), (1, 1), (0, 1)):
            if di * dj != 0 and beside == 0:
                continue
            other = n - di * nj - dj
            if other < 0 or not 0 <= j - dj < nj:
                continue
            a, b = offsets[n], offsets[other]
            while a < offsets[n + 1] and b < offsets[other + 1]:
                if runs[a, 0] < runs[b, 1] + beside and runs[b, 0] < runs[a, 1] + beside:
                    first, second = _root(parent, a), _root(parent, b)
                    parent[max(first, second)] = min(first, second)
                if runs[a, 1] < runs[b, 1]:
                    a += 1
                else:
                    b += 1
    for n in range(len(parent)):
        parent[n] = parent[parent[n]]


@nb.njit(cache=True)
def _root(parent, n):  # type: ignore[no-untyped-def]
    while parent[n] != n:
        parent[n] = parent[parent[n]]
        n = parent[n]
    return n


@nb.njit(cache=True)
def _count(offsets, runs, number, rows, counts):  # type: ignore[no-untyped-def]
    """Voxels of each piece where another mask is True."""
    for n in range(len(rows)):
        for a in range(offsets[n], offsets[n + 1]):
            for k in range(runs[a, 0], runs[a, 1]):
                counts[number[a]] += rows[n, k]


@nb.njit(cache=True)
def _fill(offsets, runs, kept, rows):  # type: ignore[no-untyped-def]
    """Set the voxels of some runs."""
    for n in range(len(rows)):
        for a in range(offsets[n], offsets[n + 1]):
            for k in range(runs[a, 0], runs[a, 1] if kept[a] else 0):
                rows[n, k] = True
