"""One array order for every volume: axis 0 runs mostly to the patient's left, 1 to the back, 2 to the head."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


@dataclass(frozen=True, eq=False)
class Oriented:
    """An array in canonical order.

    Attributes:
        values: Shape (nx, ny, nz), a view of what was given.
        T_ct_index: Shape (4, 4), maps an index of ``values`` to LPS mm; its determinant is positive.
    """

    values: NDArray[Any]
    T_ct_index: NDArray[np.float64]

    @property
    def spacing_mm(self) -> NDArray[np.float64]:
        """Voxel size along each axis, shape (3,), mm."""
        return np.asarray(np.linalg.norm(self.T_ct_index[:3, :3], axis=0))


TILE = (32, 64)
"""Slices and rows that are copied at a time: what they take lies in a processor's own memory."""


def in_order(values: NDArray[Any], dtype: DTypeLike) -> NDArray[Any]:
    """A copy that lies in memory in the order of its axes, the last one fastest, as every mask does that is made of it.

    Args:
        values: Shape (nx, ny, nz), in any order, such as a view of a file that runs the other way.
        dtype: Of the copy.
    """
    found = np.empty(values.shape, dtype)
    for k in range(0, values.shape[2], TILE[0]):
        for j in range(0, values.shape[1], TILE[1]):
            tile = (slice(None), slice(j, j + TILE[1]), slice(k, k + TILE[0]))
            found[tile] = values[tile]
    return found


def canonical(values: NDArray[Any], T_ct_index: NDArray[np.float64]) -> Oriented:
    """The same voxels with their axes permuted and flipped so that they run along +L, +P, +S as nearly as can be.

    What an algorithm makes of a volume may depend on the array's order (ambiguous cells of marching cubes do);
    after this step it cannot depend on how the file stored it.

    Args:
        values: Shape (ni, nj, nk).
        T_ct_index: Shape (4, 4), maps index (i, j, k) to LPS mm.
    """
    axes = T_ct_index[:3, :3] / np.linalg.norm(T_ct_index[:3, :3], axis=0)
    order = max(itertools.permutations(range(3)), key=lambda p: sum(abs(axes[row, p[row]]) for row in range(3)))
    T_index_oriented = np.zeros((4, 4))
    T_index_oriented[3, 3] = 1.0
    flips = []
    for row, axis in enumerate(order):
        backward = bool(axes[row, axis] < 0)
        T_index_oriented[axis, row] = -1.0 if backward else 1.0
        T_index_oriented[axis, 3] = values.shape[axis] - 1 if backward else 0
        flips.append(slice(None, None, -1 if backward else 1))
    T_ct_oriented = T_ct_index @ T_index_oriented
    return Oriented(values.transpose(order)[tuple(flips)], T_ct_oriented)
