"""Segments of a Slicer segmentation (.seg.nrrd), which may overlap: each is a label of one layer, and becomes a mask.

Source: Slicer documentation, "Segmentations", file format: ``SegmentN_Name``, ``SegmentN_LabelValue`` and, where the
file has several layers, ``SegmentN_Layer``, counted from 0.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.text import check_name
from puncture_twin.planning.formats.dicom.named_masks import Mask, MaskVolume, NamedMasks, unique_names
from puncture_twin.planning.formats.labels.labelmaps import MAX_LABEL
from puncture_twin.planning.formats.volumes.nrrd_header import parse_layered_header
from puncture_twin.planning.formats.volumes.volume_files import Content
from puncture_twin.planning.formats.volumes.volume_header import VolumeHeader
from puncture_twin.planning.formats.volumes.voxels import decoded

SEGMENT_ENDING = ".nrrd"
"""Ending of segmentations that Slicer saves, in lower case: their header and voxels are one file."""
ALLOWED = "a .seg.nrrd as Slicer saves it, with names, label values and layers of its segments"


class Segment(NamedTuple):
    """Layer and label of a segment.

    Attributes:
        layer: From 0.
        label: Their value there.
    """

    layer: int
    label: int


def parse_segments(path: Path, file: str, content: Content) -> NamedMasks:
    """The segments of a Slicer segmentation, each by its name.

    Args:
        path: Its name.
        file: Its key in ``content``.
        content: Gives its bytes.

    Raises:
        InputError: No such file, no segment, or segments that share a name or a label.
    """
    header = parse_layered_header(content(file), path)
    if header.data_path != path:
        raise InputError(
            f"its voxels lie in {header.data_path.name}", where=path, allowed="header and voxels in one file"
        )
    if header.cells.dtype.kind not in "iu":
        raise InputError(f"voxels of type {header.cells.dtype}", where=path, allowed="whole numbers")
    found = listed_segments(header.fields, header.layers, path)
    listed = frozenset(found.values())
    masks = {
        name: MaskVolume(path, (file,), (name,), header, partial(_mask, content, file, header, segment, listed))
        for name, segment in found.items()
    }
    return NamedMasks(masks, header.notes)


def listed_segments(remarks: Mapping[str, str], layers: int, path: Path) -> dict[str, Segment]:
    """Name to layer and label, of every segment that the header lists.

    Args:
        remarks: The header's ``key:=value`` lines.
        layers: How many the file holds; the layer of a segment may be left out where it is one.
        path: The file, for errors.

    Raises:
        InputError: No segment, or some that share a name or a voxel value of one layer, or lie in no layer.
    """
    numbers = sorted({int(at[1]) for key in remarks if (at := re.match(r"Segment(\d{1,6})_", key))})
    names = [check_name(remarks.get(f"Segment{n}_Name", ""), f"segment {n}", where=path) for n in numbers]
    unique_names(names, path)
    segments = [_segment(remarks, number, layers, path) for number in numbers]
    for name, segment in zip(names, segments, strict=True):
        if segments.count(segment) > 1:
            what = f"segment {name!r} shares label {segment.label} of layer {segment.layer}"
            raise InputError(what, where=path, allowed="a label of its own in its layer for each segment")
    return dict(zip(names, segments, strict=True))


def _segment(remarks: Mapping[str, str], number: int, layers: int, path: Path) -> Segment:
    label = _number(remarks, f"Segment{number}_LabelValue", None, path)
    layer = _number(remarks, f"Segment{number}_Layer", "0" if layers == 1 else None, path)
    if not (1 <= label <= MAX_LABEL and layer < layers):
        what = f"segment {number} has label {label} in layer {layer}"
        raise InputError(what, where=path, allowed=f"labels from 1 to {MAX_LABEL}, layers from 0 to {layers - 1}")
    return Segment(layer, label)


def _number(remarks: Mapping[str, str], key: str, default: str | None, path: Path) -> int:
    text = remarks.get(key, default)
    if text is None or not (text.isascii() and text.isdigit() and len(text) < 10):
        raise InputError(f"{key} is {'missing' if text is None else repr(text[:20])}", where=path, allowed=ALLOWED)
    return int(text)


def _mask(content: Content, file: str, header: VolumeHeader, segment: Segment, listed: frozenset[Segment]) -> Mask:
    voxels = decoded(memoryview(content(file)), header)
    layer = voxels[segment.layer] if header.layers > 1 else voxels
    lost = layer[~np.isin(layer, [0, *(one.label for one in listed if one.layer == segment.layer)])]
    if lost.size:
        what = f"layer {segment.layer} has voxels of {np.unique(lost)[:8].tolist()}, which are no segment's"
        raise InputError(what, where=header.data_path, allowed="a segment for each label", code="label_without_segment")
    return np.asarray(layer == segment.label).astype(np.uint8)
