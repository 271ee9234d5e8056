"""One array order for every volume: axis 0 runs mostly to the patient's left, 1 to the back, 2 to the head."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


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
