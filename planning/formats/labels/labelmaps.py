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

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.formats.volumes.volume_files import Volume

MAX_LABEL = 65_535
"""Label maps are 8 or 16 bit; a larger value means that an image was given instead."""

ALLOWED = f"whole numbers from 0 (background) to {MAX_LABEL}"

ROUNDED_BY = 0.02
"""So far a value may lie off a whole number: of labels stored in 8 bits with a slope some are off by half a step."""

LEAST_WHOLE = 0.15
"""Fraction of voxels besides the background: a blended map is whole inside its labels, an image in 4 % by chance."""

Box = tuple[slice, slice, slice]


@dataclass(frozen=True, eq=False)
class LabelMap:
    """Labels in patient space.

    Attributes:
        labels: Shape (ni, nj, nk), of the file's own type where that is whole numbers, read-only; 0 is background.
        T_ct_index: Shape (4, 4), maps voxel index (i, j, k), at the voxel's centre, to LPS mm.
        names: Label to name, as a .seg.nrrd states it, or None.
        rounded_by: How far the file's values are off whole numbers, at most.
    """

    labels: NDArray[np.integer]
    T_ct_index: NDArray[np.float64]
    names: dict[int, str] | None
    path: Path
    rounded_by: float = 0.0

    def __post_init__(self) -> None:
        labels = np.asarray(self.labels).view()
        labels.setflags(write=False)
        object.__setattr__(self, "labels", labels)

    @cached_property
    def boxes(self) -> dict[int, Box]:
        """The smallest index box around each label present."""
        found = scipy.ndimage.find_objects(self.labels.T)  # as it lies in a file: the first index runs fastest
        return {label: box[::-1] for label, box in enumerate(found, start=1) if box is not None}

    def labels_present(self) -> tuple[int, ...]:
        """The labels that at least one voxel has, rising, without the background."""
        return tuple(self.boxes)


def labelmap_of(volume: Volume, *, may_be_empty: bool = False) -> LabelMap:
    """The label map that a volume is, in LPS mm.

    Args:
        may_be_empty: Whether a map with background only is one: the mask of an organ that is not there.

    Raises:
        InputError: Values that are negative, not whole or above ``MAX_LABEL``; a map with background only; segment
            names that contradict each other.
    """
    names = segment_names(volume.fields, volume.path)
    labels, rounded_by = whole_labels(volume.values, volume.path)
    if not may_be_empty and not labels.any():
        refuse("the label map is empty: every voxel is 0", volume.path, ALLOWED, "empty")
    return LabelMap(labels, volume.T_ct_index, names, volume.path, rounded_by)


def whole_labels(values: NDArray[Any], path: Path) -> tuple[NDArray[np.integer], float]:
    """Voxels as whole numbers, and how far they were off, at most.

    Raises:
        InputError: Values that are negative, too large, or farther from whole numbers than `ROUNDED_BY`; those of a
            map that was blended by an interpolation have a code of their own.
    """
    low, high = values.min(), values.max()
    if low < -ROUNDED_BY or high > MAX_LABEL:
        refuse(f"values from {low} to {high} are not labels", path, ALLOWED, "no_labels")
    if values.dtype.kind != "f":
        return values, 0.0
    rounded = np.rint(values)
    off = np.abs(rounded - values)
    if off.max() > ROUNDED_BY:
        between = off > ROUNDED_BY
        example = float(values[between][0])
        whole = np.count_nonzero((values > ROUNDED_BY) & ~between)
        if high > 1.5 and whole > LEAST_WHOLE * np.count_nonzero(values > ROUNDED_BY):
            what = f"has values between its labels, such as {example:.3g}: it was interpolated"
            refuse(what, path, f"{ALLOWED}: resample it with nearest neighbours", "labels_blended")
        refuse(f"value {example} is not whole", path, ALLOWED, "no_labels")
    return rounded.astype(np.uint16), float(off.max())


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
            refuse(f"segment {name!r} has label value {value!r}", path, f"1 to {MAX_LABEL}", "out_of_range")
        if int(value) in names:
            what = f"segments {names[int(value)]!r} and {name!r} share label {value}"
            refuse(what, path, "one label per segment", "duplicate_label")
        names[int(value)] = name
    return names or None
