"""Structures of one file that may overlap, as a segmentation: DICOM SEG or RTSTRUCT, or a layered .seg.nrrd."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from puncture_twin.planning.anatomy.surfaces import VolumeSurfaces
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.dicom.ct_series import CtSeries
from puncture_twin.planning.formats.dicom.named_masks import NamedMasks
from puncture_twin.planning.formats.dicom.segmentation import parse_segmentation
from puncture_twin.planning.formats.dicom.storage import Kind
from puncture_twin.planning.formats.dicom.structure_set import parse_structure_set
from puncture_twin.planning.formats.labels.slicer_segments import parse_segments
from puncture_twin.planning.formats.volumes.volume_source import VolumeSource
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.init.segmentation import Assigned, Place, quoted, rules_text

NEEDS_SERIES = "an RTSTRUCT needs the CT on which it was drawn, as a DICOM series"


@dataclass(frozen=True, eq=False)
class FileMasks:
    """The structures of one file.

    Attributes:
        source: The file.
        key: Of the case: ``seg`` or ``rtstruct``.
        parts: Name to its mask and the value of its voxels, of those that are not empty.
        notes: How the file was read.
    """

    source: str
    key: str
    parts: Mapping[str, tuple[VolumeSurfaces, int]]
    notes: tuple[str, ...]
    names: Mapping[int, str] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", dict(enumerate(self.parts, start=1)))

    @property
    def voxel_ct(self) -> Floats:
        """The edges of its voxels as columns, shape (3, 3), mm."""
        return next(iter(self.parts.values()))[0].voxel_ct

    def near(self, point_ct: Floats) -> tuple[int, ...]:
        """The structures whose box holds a point (3,), LPS mm."""
        boxes = {label: self.surface(label).bounds for label in self.names}
        return tuple(n for n, (low, high) in boxes.items() if np.all((low <= point_ct) & (point_ct <= high)))

    def surface(self, label: int) -> TriangleMesh:
        """The surface of one structure, LPS mm."""
        surfaces, value = self.parts[self.names[label]]
        return surfaces.label(value)

    def section(self, rows: Sequence[Assigned]) -> str:
        """A ``[[structures]]`` of the file."""
        return f"[[structures]]\n{self.key} = {quoted(self.source)}\n{rules_text(rows)}"


def dicom_masks(place: Place, source: str, kind: Kind, ct: VolumeSource | None) -> FileMasks:
    """The structures of a file, on the slices of the CT.

    Args:
        place: The case's folder.
        source: The file.
        kind: What it is.
        ct: The CT of the case.

    Raises:
        InputError: Structures that cannot be trusted, or were drawn on another CT.
    """
    path, series = place.folder / source, ct if isinstance(ct, CtSeries) else None
    if kind is Kind.SEGMENTATION:
        key, found = "seg", parse_segmentation(path, source, place.content, series)
    elif series is None:
        raise InputError(NEEDS_SERIES, where=path, allowed="the folder of that series beside it")
    else:
        key, found = "rtstruct", parse_structure_set(path, source, place.content, series)
    return _named(place, source, key, found)


def layered_masks(place: Place, source: str) -> FileMasks:
    """The segments of a segmentation of Slicer, of which some overlap.

    Raises:
        InputError: Segments that cannot be trusted.
    """
    return _named(place, source, "seg", parse_segments(place.folder / source, source, place.content))


def _named(place: Place, source: str, key: str, found: NamedMasks) -> FileMasks:
    parts = {}
    for name, mask in found.masks.items():
        hashes = (hashlib.sha256(place.content(file)).hexdigest() for file in mask.files)
        surfaces = VolumeSurfaces(mask, (*hashes, *mask.part), place.cache)
        if (value := surfaces.mask_label()) is not None:
            parts[name] = (surfaces, value)
    return FileMasks(source, key, parts, found.notes)
