"""Parts of a structure that the centres of voxels miss: thinner than a voxel, they still belong to its label.

Where a flat surface passes a voxel, and what it bounds is as thick as the voxels, the label has this voxel or one
beside it. A voxel that a surface passes without either is the place of a part too thin for centres; a segmentation that
left it out would call a needle through it safe.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from puncture_twin.planning.base.arrays import Bools, Floats, Ints

SAMPLE_VOXELS = 0.4
"""At most so far apart are samples of a surface."""
MOST_SAMPLES = 1_000_000
"""Of triangles that are sampled together."""


def passed_voxels(corners: Floats, shape: tuple[int, int, int]) -> Ints:
    """The voxels that triangles pass, shape (m, 3), each once.

    Args:
        corners: Shape (n, 3, 3), in voxels: a voxel's centre has whole coordinates.
        shape: Of the grid; what lies outside is left out.
    """
    found = [np.empty(0, np.int64)]
    for points in _samples(corners):
        index = np.floor(points + 0.5).astype(np.int64)
        inside = np.all((index >= 0) & (index < shape), axis=1)
        found.append(np.unique(np.ravel_multi_index(tuple(index[inside].T), shape)))
    return np.stack(np.unravel_index(np.unique(np.concatenate(found)), shape), axis=1)


def missed_voxels(labels: NDArray[Any], label: int, corners: Floats, later: Bools) -> Ints:
    """The voxels that a structure passes while neither they nor those beside have its label, shape (m, 3).

    Args:
        labels: Shape (nx, ny, nz), what is labelled at each centre.
        label: The structure's.
        corners: Its triangles, shape (n, 3, 3), in voxels.
        later: Shape (largest label + 1,), which labels fill the place of this one: their voxels are not missed.
    """
    shape = (labels.shape[0], labels.shape[1], labels.shape[2])
    at = passed_voxels(corners, shape)
    if not len(at):
        return at
    low, high = np.maximum(at.min(axis=0) - 1, 0), at.max(axis=0) + 2
    box = labels[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
    beside = ndimage.binary_dilation(box == label, np.ones((3, 3, 3), bool))
    x, y, z = (at - low).T
    return at[~beside[x, y, z] & ~later[box[x, y, z]]]


def _samples(corners: Floats) -> Iterator[Floats]:
    """Points of triangles, at most `SAMPLE_VOXELS` apart, shape (m, 3) at a time."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    counts = np.maximum(1, np.ceil(edges / SAMPLE_VOXELS).astype(np.int64))
    for count in np.unique(counts).tolist():
        i, j = np.array([(i, j) for i in range(count + 1) for j in range(count + 1 - i)]).T / count
        weights = np.stack([1 - i - j, i, j])
        some = corners[counts == count]
        step = max(1, MOST_SAMPLES // len(i))
        for start in range(0, len(some), step):
            yield np.einsum("wp,twc->tpc", weights, some[start : start + step]).reshape(-1, 3)
