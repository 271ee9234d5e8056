"""Array types by what they hold, and masks and counts of voxels; each use of a type states shape, unit and frame."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Ints32 = NDArray[np.int32]
"""Faces: three rows of vertices a triangle; labels; ranks."""
Pixels = NDArray[np.uint8]
"""Pictures: rows, columns, and RGB where there is a third axis."""
Texts = NDArray[np.object_]
"""Strings of any length: an array of a fixed width would cut a name."""


class Columns:
    """A dataclass of arrays of one length, row by row; read-only."""

    def __post_init__(self) -> None:
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)


def read_only(array: ArrayLike, dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """A read-only copy of an array, any shape."""
    copy = np.array(array, dtype=dtype)
    copy.setflags(write=False)
    return copy


def rms(values: ArrayLike) -> float:
    """Root mean square of numbers (n,), or of the lengths of rows (n, k); NaN of none."""
    squares = np.square(np.asarray(values, dtype=np.float64))
    squares = squares.sum(axis=1) if squares.ndim == 2 else squares
    return float(np.sqrt(squares.mean())) if len(squares) else float("nan")


def is_frozen(array: Any, dtype: DTypeLike) -> bool:
    """Whether this is an array of a kind that nobody writes to, down to the memory that it looks at."""
    if type(array) is not np.ndarray or array.dtype != dtype or not (array.flags.c_contiguous and array.flags.aligned):
        return False
    while type(array) is np.ndarray and not array.flags.writeable:
        array = array.base
    return array is None or type(array) is bytes


def widened(mask: Bools, reach: Sequence[int] | NDArray[np.integer]) -> Bools:
    """A mask with all that lies so many voxels or fewer from it along each axis, in a box; shape of the mask."""
    for axis, most in enumerate(reach):
        done = 0
        while done < most:
            reach_step = min(2 * done + 1, most - done)  # no farther than what has grown so far has no gap
            grown_mask = mask.copy()
            _add_neighbours(grown_mask, mask, axis, reach_step)
            mask, done = grown_mask, done + reach_step
    return mask


def grown(mask: Bools) -> Bools:
    """A mask and the neighbours of its voxels, those that share a face."""
    grown_mask = mask.copy()
    for axis in range(mask.ndim):
        _add_neighbours(grown_mask, mask, axis, 1)
    return grown_mask


def _add_neighbours(target: Bools, mask: Bools, axis: int, step: int) -> None:
    """Set the voxels that lie a step from a mask in both directions of an axis."""
    out, source = np.moveaxis(target, axis, 0), np.moveaxis(mask, axis, 0)
    out[step:] |= source[:-step]
    out[:-step] |= source[step:]


def label_counts(numbers: NDArray[np.integer], count: int) -> Ints:
    """Number of voxels of each label from 0 to ``count``, shape (count + 1,); counted plane by plane."""
    counts = np.zeros(count + 1, np.int64)
    for plane in numbers:
        in_plane = np.bincount(plane.ravel())
        counts[: len(in_plane)] += in_plane
    return counts


def any_masked(values: object) -> bool:
    """Whether an array, or one of a list of arrays, has a masked value, under which any number may stand."""
    return any(np.ma.is_masked(one) for one in (values if isinstance(values, list | tuple) else [values]))
