"""Structures of one file that may overlap, as a segmentation: DICOM SEG or RTSTRUCT, or a layered .seg.nrrd."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.anatomy.surfaces import VolumeSurfaces
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.tables import StructuresSection
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.init.segmentation import Assigned, Place, quoted, rules_text


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

    def skin(self, label: int) -> Skin:
        """None of them: a case takes its skin from a CT, a mesh, or a label of a map.

        Raises:
            InputError: Always.
        """
        what = f"'{self.names[label]}' cannot be the skin, as one of the overlapping structures of a file"
        raise InputError(what, where=self.source, allowed="a CT, a mesh, or a label of a label map", code="no_skin")

    def section(self, rows: Sequence[Assigned]) -> str:
        """A ``[[structures]]`` of the file."""
        return f"[[structures]]\n{self.key} = {quoted(self.source)}\n{rules_text(rows)}"


def file_masks(place: Place, source: str, key: str, ct: str | None) -> FileMasks:
    """The structures of a file: of DICOM on the slices of the CT, or segments of Slicer, of which some overlap.

    Args:
        place: The case's folder.
        source: The file.
        key: Of the case: ``seg`` or ``rtstruct``.
        ct: The CT of the case, read before, or None.

    Raises:
        InputError: Structures that cannot be trusted, or were drawn on another CT.
    """
    place.content(source)
    place.volumes.read_masks(StructuresSection.model_validate({key: source}), ct)
    read = {name: place.surfaces(volume) for name, volume in place.volumes.masks(source).items()}
    parts = {name: (surfaces, value) for name, surfaces in read.items() for value in surfaces.mask().labels}
    return FileMasks(source, key, parts, place.volumes.mask_notes(source))
