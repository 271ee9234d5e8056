"""Which corners of a convex hull share an edge."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats


class Neighbours(NamedTuple):
    """The edges of a convex hull of n corners."""

    degrees: NDArray[np.int64]
    """Shape (n,): how many neighbours each corner has."""
    rows: NDArray[np.int64]
    """The neighbours of the first corner, of the second, and so on."""


def neighbours(corners: Floats) -> Neighbours:
    """Which corners (n, 3) of a convex hull share an edge of its triangles; a corner within the hull has none."""
    faces = scipy.spatial.ConvexHull(corners).simplices
    edges = np.concatenate([np.roll(faces, turn, axis=1)[:, :2] for turn in range(3)])
    pairs = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0).astype(np.int64)
    return Neighbours(np.bincount(pairs[:, 0], minlength=len(corners)), pairs[:, 1])
