"""The arrays of this project by what they hold; a docstring beside each use gives shape, unit and frame."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
"""Faces: three rows of vertices a triangle; labels; ranks."""

Pixels = NDArray[np.uint8]
"""Pictures: rows, columns, and RGB where there is a third axis."""

Texts = NDArray[np.object_]
"""Strings of any length: an array of a fixed width would cut a name."""


def read_only(array: ArrayLike) -> Floats:
    """A copy, any shape, that nobody can write to."""
    copy = np.array(array, dtype=np.float64)
    copy.setflags(write=False)
    return copy
