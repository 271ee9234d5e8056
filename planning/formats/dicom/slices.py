"""The slices of CT files: where each lies, and how its stored values become Hounsfield units.

A classic file holds one slice; an enhanced one holds many, each with functional groups of its own or shared by all
(DICOM PS3.3, C.7.6.16). Here both are the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydicom.dataset import Dataset

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.dicom.dicom_file import has, items, name, number, numbers, sop_class_of, text, texts
from puncture_twin.planning.formats.dicom.recognise import NO_SLICES
from puncture_twin.planning.formats.dicom.storage import CLASSIC_CT
from puncture_twin.planning.formats.volumes.volume_header import MAX_ORIGIN_MM, MAX_SPACING_MM, MIN_SPACING_MM

UNIT_TOLERANCE = 1e-3
"""Of an axis' length, and of the cosine between two: positions are written with six digits, some with four."""
HOUNSFIELD = ("HU", "US", "")
"""Types of rescaled values that are Hounsfield units in a CT, where the standard's default is HU."""
WITH_RESCALE = (
    "slices with slope and intercept (usually 1 and -1024 where air is stored as 0; 1 and 0 where as -1000): "
    "export the series again from where it was made, or give the CT as NIfTI in Hounsfield units"
)


@dataclass(frozen=True, eq=False)
class Plane:
    """Where an image lies.

    Attributes:
        origin_ct: Shape (3,), the centre of its first pixel, LPS mm.
        axes_ct: Shape (3, 2), unit vectors: along a row (with rising column), and along a column.
        spacing_mm: Distance of neighbouring pixels along a row, and along a column.
    """

    origin_ct: Floats
    axes_ct: Floats
    spacing_mm: tuple[float, float]

    @property
    def normal_ct(self) -> Floats:
        """Shape (3,), a unit vector: rows, columns and it are right-handed."""
        return np.asarray(np.cross(self.axes_ct[:, 0], self.axes_ct[:, 1]))


@dataclass(frozen=True, eq=False)
class Slice:
    """One slice of a CT.

    Attributes:
        file: The file's name, as its bytes are wanted.
        frame: Its number in the file, from 0.
        label: How a person finds it.
        plane: Where it lies.
        slope: What a stored value is multiplied with.
        intercept: What is added then; the sum is in Hounsfield units.
    """

    file: str
    frame: int
    label: str
    plane: Plane
    slope: float
    intercept: float


def slices_of(data: Dataset, file: str, frames: int) -> list[Slice]:
    """The slices of a CT file; scouts among the frames of an enhanced one are left out.

    Args:
        data: The file's data set.
        file: Its name.
        frames: How many images it holds.

    Raises:
        InputError: A position, an axis, a spacing or a rescaling is missing, contradictory or not in Hounsfield units.
    """
    if sop_class_of(data, where=file) == CLASSIC_CT:
        if frames != 1:
            what = f"{name('NumberOfFrames')} is {frames} in a CT image of one slice"
            raise InputError(what, where=file, allowed="one frame, or an Enhanced CT image")
        return [_slice(file, 0, file, Groups(data, data))]
    found = []
    for frame, groups in enumerate(frame_groups(data, frames, where=file)):
        label = f"{file}, frame {frame + 1}"
        kinds = [part.upper() for one in groups.find("CTImageFrameTypeSequence", label) for part in _types(one, label)]
        if not set(kinds) & NO_SLICES:
            found.append(_slice(file, frame, label, groups))
    return found


@dataclass(frozen=True, eq=False)
class Groups:
    """The functional groups of one frame: its own, and those shared by all. Of a classic image, the image itself."""

    own: Dataset
    shared: Dataset

    def find(self, keyword: str, label: str) -> list[Dataset]:
        """The items of one group."""
        return items(self.own, keyword, where=label) or items(self.shared, keyword, where=label)

    def holder(self, keyword: str, label: str) -> Dataset:
        """The one item of a group; of a classic image, which has no groups, the image itself.

        Raises:
            InputError: The group is missing.
        """
        if self.own is self.shared:
            return self.own
        found = self.find(keyword, label)
        if len(found) != 1:
            raise InputError(f"{name(keyword)} has {len(found)} items", where=label, allowed="one for each frame")
        return found[0]


def frame_groups(data: Dataset, frames: int, *, where: str) -> list[Groups]:
    """The functional groups of each frame of a multi-frame image.

    Raises:
        InputError: There are more or fewer of them than frames.
    """
    own = items(data, "PerFrameFunctionalGroupsSequence", where=where)
    if len(own) != frames:
        what = f"{name('PerFrameFunctionalGroupsSequence')} has {len(own)} items for {frames} frames"
        raise InputError(what, where=where, allowed="one for each frame")
    shared = items(data, "SharedFunctionalGroupsSequence", where=where)
    return [Groups(one, shared[0] if shared else Dataset()) for one in own]


def plane_of(groups: Groups, label: str) -> Plane:
    """Where a frame lies.

    Raises:
        InputError: Position, orientation or spacing is missing or wrong.
    """
    origin = numbers(groups.holder("PlanePositionSequence", label), "ImagePositionPatient", 3, where=label)
    cosines = numbers(groups.holder("PlaneOrientationSequence", label), "ImageOrientationPatient", 6, where=label)
    between_rows, between_columns = numbers(
        groups.holder("PixelMeasuresSequence", label), "PixelSpacing", 2, where=label
    )
    if max(map(abs, origin)) > MAX_ORIGIN_MM:
        raise InputError(
            f"{name('ImagePositionPatient')} is {list(origin)}", where=label, allowed=f"{MAX_ORIGIN_MM} mm"
        )
    if not all(MIN_SPACING_MM <= one <= MAX_SPACING_MM for one in (between_rows, between_columns)):
        allowed = f"{MIN_SPACING_MM} to {MAX_SPACING_MM} mm"
        raise InputError(
            f"{name('PixelSpacing')} is {between_rows:g}, {between_columns:g}", where=label, allowed=allowed
        )
    if max(map(abs, cosines)) > 2:
        raise InputError(f"{name('ImageOrientationPatient')} is {list(cosines)}", where=label, allowed="unit vectors")
    axes = np.array(cosines).reshape(2, 3).T
    lengths = np.linalg.norm(axes, axis=0)
    if np.abs(lengths - 1.0).max() > UNIT_TOLERANCE or abs(axes[:, 0] @ axes[:, 1]) > UNIT_TOLERANCE:
        what = f"{name('ImageOrientationPatient')} is {list(cosines)}"
        raise InputError(what, where=label, allowed="two unit vectors at a right angle")
    row = axes[:, 0] / lengths[0]
    column = axes[:, 1] - (axes[:, 1] @ row) * row
    square = np.stack([row, column / np.linalg.norm(column)], axis=1)
    return Plane(np.array(origin), square, (between_columns, between_rows))


def _slice(file: str, frame: int, label: str, groups: Groups) -> Slice:
    rescale = groups.holder("PixelValueTransformationSequence", label)
    kind = text(rescale, "RescaleType", where=label)
    if kind not in HOUNSFIELD:
        raise InputError(f"{name('RescaleType')} is {kind!r}", where=label, allowed="HU (Hounsfield units)")
    for keyword in ("RescaleSlope", "RescaleIntercept"):
        if not has(rescale, keyword):
            what = f"{name(keyword)} is missing, so that nothing tells its Hounsfield units"
            raise InputError(what, where=label, allowed=WITH_RESCALE, code="no_rescale")
    slope, intercept = (number(rescale, keyword, where=label) for keyword in ("RescaleSlope", "RescaleIntercept"))
    if slope == 0 or abs(slope) > 1e6 or abs(intercept) > 1e6:
        what = f"rescaling by {slope:g} and {intercept:g}"
        raise InputError(what, where=label, allowed="a slope other than 0, both within a million")
    return Slice(file, frame, label, plane_of(groups, label), slope, intercept)


def _types(item: Dataset, label: str) -> tuple[str, ...]:
    return texts(item, "FrameType", where=label)
