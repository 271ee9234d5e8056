"""What the voxels hold in which points lie."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb


def nearest(values: NDArray[np.float32], T_index_ct: Floats, points_ct: Floats) -> Floats:
    """Values of the nearest voxels, NaN outside of the image; half way between two it is the one of even index.

    Args:
        values: Shape (nx, ny, nz).
        T_index_ct: Shape (4, 4), maps LPS mm to an index of ``values``.
        points_ct: Shape (n, 3), LPS mm.
    """
    order = np.argsort(values.strides)[::-1]  # as it lies in memory: the kernel is compiled for one order alone
    plain = np.ascontiguousarray(values.transpose(order))
    return np.asarray(_nearest(plain, T_index_ct[order], np.ascontiguousarray(points_ct)))


@nb.njit(cache=True, error_model="numpy")
def _nearest(values: Any, T: Any, points: Any) -> Any:
    """As `nearest`, of values that lie in memory as they are numbered. The order of a sum decides half-way points."""
    found = np.empty(len(points))
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        i = np.rint(T[0, 0] * x + T[0, 2] * z + T[0, 1] * y + T[0, 3])
        j = np.rint(T[1, 0] * x + T[1, 2] * z + T[1, 1] * y + T[1, 3])
        k = np.rint(T[2, 0] * x + T[2, 2] * z + T[2, 1] * y + T[2, 3])
        if 0 <= i < values.shape[0] and 0 <= j < values.shape[1] and 0 <= k < values.shape[2]:
            found[n] = values[int(i), int(j), int(k)]
        else:
            found[n] = np.nan
    return found
