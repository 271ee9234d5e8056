"""Which voxels of a grid lie inside a surface: parity of its crossings along grid lines."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.mesh import TriangleMesh, box_of
from puncture_twin.planning.geometry.rigid import apply

OFF_LINE = (0.000137, 0.000211)
"""Voxels by which the lines pass next to the voxels' centres in j and k, so that none runs through an edge or a corner
of a surface that was made on the same grid. A line that does all the same flips its voxels by one edge too many."""


def voxels_inside(mesh: TriangleMesh, T_ct_index: Floats, shape: tuple[int, ...]) -> Bools:
    """Voxels whose centres lie inside a surface, or through which it passes where it is open.

    Args:
        mesh: LPS mm. Of an open surface the inside is not known; its own voxels are returned.
        T_ct_index: Shape (4, 4), voxel index to LPS mm.

    Returns:
        Shape ``shape``.
    """
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
