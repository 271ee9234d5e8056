"""Connected parts of a mask, by runs of voxels along its last axis: no grid of numbers is made or read.

A large scan has a hundred million voxels and a few hundred thousand runs. Two runs of neighbouring lines that touch
are of one part (union-find, the older run is the root, so that one pass forward numbers them all).

Which voxels lie inside a surface: parity of its crossings along grid lines.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats, Ints, Ints32
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.mesh import TriangleMesh, box_of
from puncture_twin.planning.geometry.rigid import apply

OFF_LINE = (0.000137, 0.000211)
"""Voxels by which the lines pass next to the voxels' centres in j and k, so that none runs through an edge or a corner
of a surface that was made on the same grid. A line that does all the same flips its voxels by one edge too many."""


def voxels_inside(mesh: TriangleMesh, T_ct_index: Floats, shape: tuple[int, ...]) -> Bools:
    """Voxels, by the map (4, 4) of an index to LPS mm, with centres inside a surface, or of an open one its own."""
    mask = np.zeros(shape, bool)
    mark_inside(mesh, T_ct_index, mask)
    return mask


def mark_inside(mesh: TriangleMesh, T_ct_index: Floats, mask: Bools) -> None:
    """Add the voxels of `voxels_inside` to those set in a mask; only the surface's box is visited."""
    vertices = apply(np.linalg.inv(T_ct_index), mesh.vertices)
    corners = vertices[mesh.faces]
    if not mesh.closed:
        mask |= _voxels_on(corners, mask.shape)
        return
    low, high = np.clip(np.floor(box_of(vertices)).astype(np.int64) + [[0], [2]], 0, mask.shape)
    if (low >= high).any():
        return
    inside = np.zeros(high - low, np.uint8)
    _flip_behind_crossings(corners, OFF_LINE, low, inside)
    for i in range(1, len(inside)):
        inside[i] ^= inside[i - 1]
    mask[tuple(map(slice, low, high))] |= inside.view(bool)


@nb.njit(cache=True)
def _flip_behind_crossings(corners, off, first, flips):  # type: ignore[no-untyped-def]  # numba infers
    """Flip, at each crossing of a line along i, the first voxel of a box whose centre lies behind it."""
    ni, nj, nk = flips.shape
    for t in range(len(corners)):
        a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
        low_j, high_j = min(a[1], b[1], c[1]) - off[0], max(a[1], b[1], c[1]) - off[0]
        low_k, high_k = min(a[2], b[2], c[2]) - off[1], max(a[2], b[2], c[2]) - off[1]
        for j in range(max(first[1], int(np.ceil(low_j))), min(first[1] + nj - 1, int(np.floor(high_j))) + 1):
            for k in range(max(first[2], int(np.ceil(low_k))), min(first[2] + nk - 1, int(np.floor(high_k))) + 1):
                y, z = j + off[0], k + off[1]
                wa = (b[1] - y) * (c[2] - z) - (b[2] - z) * (c[1] - y)
                wb = (c[1] - y) * (a[2] - z) - (c[2] - z) * (a[1] - y)
                wc = (a[1] - y) * (b[2] - z) - (a[2] - z) * (b[1] - y)
                if (wa > 0 and wb > 0 and wc > 0) or (wa < 0 and wb < 0 and wc < 0):
                    x = (wa * a[0] + wb * b[0] + wc * c[0]) / (wa + wb + wc)
                    i = max(0, int(np.ceil(x)) - first[0])
                    if i < ni:
                        flips[i, j - first[1], k - first[2]] ^= 1


def _voxels_on(corners: Floats, shape: tuple[int, ...]) -> Bools:
    """Voxels that hold a point of the triangles (m, 3, 3), in voxels, sampled at half a voxel."""
    mask = np.zeros(shape, bool)
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1, initial=0.0)
    counts = np.maximum(1, np.ceil(2 * edges)).astype(int)
    for count in np.unique(counts):
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        weights = np.stack([i, j, count - i - j], axis=-1)[i + j <= count] / count
        points = np.einsum("wc,tcx->twx", weights, corners[counts == count]).reshape(-1, 3)
        voxels = np.round(points).astype(np.int64)
        voxels = voxels[np.all((voxels >= 0) & (voxels < shape), axis=1)]
        mask[tuple(voxels.T)] = True
    return mask


@dataclass(frozen=True, eq=False)
class Parts:
    """The parts of a mask, numbered from 0, as they are met.

    By run the line's two indices, its first voxel and the one after its last, (n, 4), and its part, (n,).
    """

    shape: tuple[int, ...]
    runs: Ints32  # shape (n, 4), of each run the line's two indices, its first voxel and the one after its last
    part: Ints32

    @cached_property
    def sizes(self) -> Ints:
        """Voxels of each part."""
        return np.bincount(self.part, self.runs[:, 3] - self.runs[:, 2]).astype(np.int64)

    def counts(self, where: Bools) -> Ints:
        """How many voxels of each part another mask has, of the same shape."""
        held = np.zeros(len(self.runs), np.int64)
        _count(_plain(where), self.runs, held)
        return np.bincount(self.part, held, len(self.sizes)).astype(np.int64)

    def painted(self, values: NDArray[Any]) -> NDArray[Any]:
        """A grid with a value (parts,), a whole number or flag, of its own in each part, and zero outside of all."""
        grid = np.zeros(self.shape, values.dtype)
        _paint(self.runs, values[self.part], grid)
        return grid


def parts_of(mask: Bools, *, corners: bool = False) -> Parts:
    """The parts of a mask, shape (nx, ny, nz), whose voxels share faces; with ``corners`` edges and corners too."""
    return Parts(mask.shape, *_runs_and_parts(_plain(mask), int(corners)))


def largest_part(mask: Bools) -> Bools:
    """The largest part of a mask; the mask itself where it is empty."""
    parts = parts_of(mask)
    return parts.painted(np.arange(len(parts.sizes)) == np.argmax(parts.sizes)) if len(parts.sizes) else mask


def slice_counts(mask: Bools) -> tuple[Ints, Ints, Ints]:
    """How many voxels of a mask each slice across an axis has, by axis."""
    lines = mask.sum(axis=0, dtype=np.uint32)
    across = np.array([np.count_nonzero(plane) for plane in mask])
    return across, lines.sum(axis=1, dtype=np.int64), lines.sum(axis=0, dtype=np.int64)


def middle_of(mask: Bools) -> Floats:
    """The middle of a mask's voxels, shape (3,), voxels; NaN of none."""
    counts = slice_counts(mask)
    return np.array([np.arange(len(some)) @ some for some in counts]) / np.float64(counts[0].sum())


def ends_of(mask: Bools) -> tuple[Ints32, Ints32, Ints32, Ints32]:
    """First and last voxel of a mask along axis 0, shape (ny, nz), and along axis 1, (nx, nz); -1 of a line without."""
    nx, ny, nz = mask.shape
    ends = [np.full(shape, -1, np.int32) for shape in ((ny, nz), (ny, nz), (nx, nz), (nx, nz))]
    _find_ends(_plain(mask), *ends)
    return ends[0], ends[1], ends[2], ends[3]


def in_blocks(mask: Bools, edge: NDArray[np.int_]) -> Ints32:
    """How many voxels of a mask each block of ``edge`` voxels (3,) holds; the last ones may be cut."""
    counts = np.zeros([-(-n // size) for n, size in zip(mask.shape, edge.tolist(), strict=True)], np.int32)
    _count_in_blocks(_plain(mask), edge, counts)
    return counts


def _plain(mask: Bools) -> Bools:
    return np.require(mask, requirements=["C", "W"])


@nb.njit(cache=True)
def _count_in_blocks(mask: Any, edge: Any, counts: Any) -> None:
    a, b, c = edge
    nx, ny, nz = mask.shape
    row = np.empty(nz, np.int32)
    for i in range(counts.shape[0]):
        for j in range(counts.shape[1]):
            row[:] = 0
            for x in range(i * a, min((i + 1) * a, nx)):
                for y in range(j * b, min((j + 1) * b, ny)):
                    for k in range(nz):  # along memory, so that the compiler adds many at once
                        row[k] += mask[x, y, k]
            for k in range(nz):
                counts[i, j, k // c] += row[k]


@nb.njit(cache=True)
def _find_ends(mask: Any, first_i: Any, last_i: Any, first_j: Any, last_j: Any) -> None:
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            for k in range(mask.shape[2]):
                if mask[i, j, k]:
                    first_i[j, k] = i if first_i[j, k] < 0 else first_i[j, k]
                    first_j[i, k] = j if first_j[i, k] < 0 else first_j[i, k]
                    last_i[j, k], last_j[i, k] = i, j


@nb.njit(cache=True)
def _runs_and_parts(mask: Any, diagonal: Any) -> Any:
    """Runs (n, 4), and the part (n,) of each; ``diagonal`` is 1 where edges and corners count."""
    nx, ny, nz = mask.shape
    count = 0
    for i in range(nx):
        for j in range(ny):
            count += mask[i, j, 0]
            for k in range(1, nz):
                count += mask[i, j, k] > mask[i, j, k - 1]
    runs, root = np.empty((count, 4), np.int32), np.empty(count, np.int32)
    first = np.zeros(nx * ny + 1, np.int64)
    n = 0
    for i in range(nx):
        for j in range(ny):
            inside = False
            for k in range(nz):
                if mask[i, j, k] != inside:
                    inside = not inside
                    if inside:
                        runs[n, 0], runs[n, 1], runs[n, 2], root[n] = i, j, k, n
                    else:
                        runs[n, 3] = k
                        n += 1
            if inside:
                runs[n, 3] = nz
                n += 1
            line = i * ny + j
            first[line + 1] = n
            for y in range(max(0, j - diagonal), min(ny, j + diagonal + 1) if i > 0 else 0):
                _join(runs, root, first, line - ny + y - j, line, diagonal)
            if j > 0:
                _join(runs, root, first, line - 1, line, diagonal)
    parts = 0
    for r in range(count):
        if root[r] == r:
            root[r] = parts
            parts += 1
        else:
            root[r] = root[root[r]]
    return runs, root


@nb.njit(cache=True)
def _join(runs: Any, root: Any, first: Any, line: Any, other: Any, diagonal: Any) -> None:
    """Make one part of the runs of two lines that overlap, or are so many voxels apart."""
    a, b = first[line], first[other]
    while a < first[line + 1] and b < first[other + 1]:
        if runs[a, 2] < runs[b, 3] + diagonal and runs[b, 2] < runs[a, 3] + diagonal:
            p, q = _root(root, a), _root(root, b)
            root[max(p, q)] = min(p, q)
        if runs[a, 3] < runs[b, 3]:
            a += 1
        else:
            b += 1


@nb.njit(cache=True)
def _root(root: Any, r: Any) -> Any:
    while root[r] != r:
        root[r] = root[root[r]]
        r = root[r]
    return r


@nb.njit(cache=True)
def _count(mask: Any, runs: Any, held: Any) -> None:
    for r in range(len(runs)):
        for k in range(runs[r, 2], runs[r, 3]):
            held[r] += mask[runs[r, 0], runs[r, 1], k]


@nb.njit(cache=True)
def _paint(runs: Any, values: Any, grid: Any) -> None:
    for r in range(len(runs)):
        if values[r]:
            for k in range(runs[r, 2], runs[r, 3]):
                grid[runs[r, 0], runs[r, 1], k] = values[r]
