"""Label maps: a whole number per voxel that says which structure it belongs to."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.volumes.volume_files import Volume

MAX_LABEL = 65_535
"""Label maps are 8 or 16 bit; a larger value means that an image was given instead."""

Box = tuple[slice, slice, slice]


@dataclass(frozen=True, eq=False)
class LabelMap:
    """Labels in patient space.

    Attributes:
        labels: Shape (ni, nj, nk), of the file's own type where that is whole numbers, read-only; 0 is background.
        T_ct_index: Shape (4, 4), maps voxel index (i, j, k), at the voxel's centre, to LPS mm.
        names: Label to name, as a .seg.nrrd states it, or None.
        path: Where it came from.
    """

    labels: NDArray[np.integer]
    T_ct_index: NDArray[np.float64]
    names: dict[int, str] | None
    path: Path

    def __post_init__(self) -> None:
        labels = np.asarray(self.labels).view()
        labels.setflags(write=False)
        object.__setattr__(self, "labels", labels)

    @cached_property
    def boxes(self) -> dict[int, Box]:
        """The smallest index box around each label present."""
        found = scipy.ndimage.find_objects(self.labels)
        return {label: box for label, box in enumerate(found, start=1) if box is not None}

    def labels_present(self) -> tuple[int, ...]:
        """The labels that at least one voxel has, rising, without the background."""
        return tuple(self.boxes)


def labelmap_of(volume: Volume, *, may_be_empty: bool = False) -> LabelMap:
    """The label map that a volume is, in LPS mm.

    Args:
        volume: The volume.
        may_be_empty: Whether a map with background only is one: the mask of an organ that is not there.

    Raises:
        InputError: Values that are negative, not whole or above ``MAX_LABEL``; a map with background only; segment
            names that contradict each other.
    """
    names = segment_names(volume.fields, volume.path)
    return LabelMap(_whole(volume.values, volume.path, may_be_empty), volume.T_ct_index, names, volume.path)


def _whole(values: NDArray[Any], path: Path, may_be_empty: bool) -> NDArray[np.integer]:
    allowed = f"whole numbers from 0 (background) to {MAX_LABEL}"
    low, high = values.min(), values.max()
    if low < 0 or high > MAX_LABEL:
        raise InputError(f"values from {low} to {high} are no labels", where=path, allowed=allowed)
    if high == 0 and not may_be_empty:
        raise InputError("the label map is empty: every voxel is 0", where=path, allowed=allowed)
    if values.dtype.kind != "f":
        return values
    labels = values.astype(np.uint16)
    if not np.array_equal(labels, values):
        example = float(values[labels != values][0])
        raise InputError(f"value {example} is not whole", where=path, allowed=allowed)
    return labels


def segment_names(fields: dict[str, str], path: Path) -> dict[int, str] | None:
    """Label to name from the remarks ``SegmentN_Name`` and ``SegmentN_LabelValue`` of a Slicer segmentation.

    Raises:
        InputError: Names that contradict each other.
    """
    names: dict[int, str] = {}
    for key, name in fields.items():
        number = re.fullmatch(r"Segment(\d+)_Name", key)
        if number is None:
            continue
        value = fields.get(f"Segment{number[1]}_LabelValue", "")
        if not (value.isascii() and value.isdigit() and 0 < int(value) <= MAX_LABEL):
            raise InputError(f"segment {name!r} has label value {value!r}", where=path, allowed=f"1 to {MAX_LABEL}")
        if int(value) in names:
            what = f"segments {names[int(value)]!r} and {name!r} share label {value}"
            raise InputError(what, where=path, allowed="one label per segment")
        names[int(value)] = name
    return names or None
