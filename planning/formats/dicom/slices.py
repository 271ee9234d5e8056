"""The slices of CT files: Hounsfield units and place of each, and whether together they make one regular stack.

A classic file holds one slice; an enhanced one holds many, each with functional groups of its own or shared by all
(DICOM PS3.3, C.7.6.16). Here both are the same. Order and steps come from each slice's own position and orientation.
Names, instance numbers and slice locations are not used: they are often wrong, and nothing in the patient depends on
them.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.formats.dicom.dicom_file import items, name, number, numbers, sop_class_of, text, texts
from puncture_twin.planning.formats.dicom.recognise import NO_SLICES
from puncture_twin.planning.formats.dicom.storage import CLASSIC_CT
from puncture_twin.planning.formats.volumes.volume_header import MAX_ORIGIN_MM, MAX_SPACING_MM, MIN_SPACING_MM

UNIT_TOLERANCE = 1e-3
"""Tolerance of an axis' length, and of the cosine between two: positions are written with six digits, some with
four."""
HOUNSFIELD = ("HU", "US", "")
"""Types of rescaled values that are Hounsfield units in a CT, where the standard's default is HU."""
WITH_RESCALE = (
    "slices with slope and intercept (usually 1 and -1024 where air is stored as 0; 1 and 0 where as -1000): export "
    "the series again from its source, or give the CT as NIfTI in Hounsfield units"
)


@dataclass(frozen=True, eq=False)
class Plane:
    """Position and orientation of an image."""

    origin_ct: Floats  # shape (3,), the centre of its first pixel, LPS mm
    axes_ct: Floats  # shape (3, 2), unit vectors: along a row (with rising column), and along a column
    spacing_mm: tuple[float, float]  # distance of neighbouring pixels along a row, and along a column

    @property
    def normal_ct(self) -> Floats:
        """Shape (3,), a unit vector: rows, columns and it are right-handed."""
        return np.asarray(np.cross(self.axes_ct[:, 0], self.axes_ct[:, 1]))


@dataclass(frozen=True, eq=False)
class Slice:
    """One slice of a CT."""

    file: str  # the file's key in ``content``
    frame: int  # its number in the file, from 0
    label: str
    plane: Plane
    slope: float  # what a stored value is multiplied with
    intercept: float  # what is added then; the sum is in Hounsfield units
    acquisition: str  # the number of the scan of which it is; empty where it is not stated


def slices_of(data: Dataset, file: str, frames: int) -> list[Slice]:
    """The slices of a CT file of so many frames; scouts among those of an enhanced one are left out.

    Raises InputError: a place, an axis, a spacing or a rescaling is missing, contradictory or not in Hounsfield units.
    """
    if sop_class_of(data, where=file) == CLASSIC_CT:
        if frames != 1:
            what = f"{name('NumberOfFrames')} is {frames} in a CT image of one slice"
            refuse(what, file, "one frame, or an Enhanced CT image", "wrong_count")
        return [_slice(file, 0, file, Groups(data, data))]
    headers = []
    for frame, groups in enumerate(frame_groups(data, frames, where=file)):
        label = f"{file}, frame {frame + 1}"
        types = [texts(one, "FrameType", where=label) for one in groups.find("CTImageFrameTypeSequence", label)]
        if not {part.upper() for some in types for part in some} & NO_SLICES:
            headers.append(_slice(file, frame, label, groups))
    return headers


@dataclass(frozen=True, eq=False)
class Groups:
    """The functional groups of one frame: its own, and those shared by all. Of a classic image, the image itself."""

    own: Dataset
    shared: Dataset

    def find(self, keyword: str, label: str) -> list[Dataset]:
        """The items of one group."""
        return items(self.own, keyword, where=label) or items(self.shared, keyword, where=label)

    def holder(self, keyword: str, label: str) -> Dataset:
        """The one item of a group, or a classic image, which has no groups, itself. Raises InputError: no group."""
        if self.own is self.shared:
            return self.own
        found = self.find(keyword, label)
        if len(found) != 1:
            refuse(f"{name(keyword)} has {len(found)} items", label, "one for each frame", "wrong_count")
        return found[0]


def frame_groups(data: Dataset, frames: int, *, where: str) -> list[Groups]:
    """The functional groups of each frame. Raises InputError: there are more or fewer of them than frames."""
    own = items(data, "PerFrameFunctionalGroupsSequence", where=where)
    if len(own) != frames:
        what = f"{name('PerFrameFunctionalGroupsSequence')} has {len(own)} items for {frames} frames"
        refuse(what, where, "one for each frame", "wrong_count")
    shared = items(data, "SharedFunctionalGroupsSequence", where=where)
    return [Groups(one, shared[0] if shared else Dataset()) for one in own]


def plane_of(groups: Groups, label: str) -> Plane:
    """Position and orientation of a frame. Raises InputError: position, orientation or spacing is missing or wrong."""
    origin = numbers(groups.holder("PlanePositionSequence", label), "ImagePositionPatient", 3, where=label)
    cosines = numbers(groups.holder("PlaneOrientationSequence", label), "ImageOrientationPatient", 6, where=label)
    measures = groups.holder("PixelMeasuresSequence", label)
    between_rows, between_columns = numbers(measures, "PixelSpacing", 2, where=label)
    if max(map(abs, origin)) > MAX_ORIGIN_MM:
        refuse(f"{name('ImagePositionPatient')} is {list(origin)}", label, f"{MAX_ORIGIN_MM} mm", "too_far")
    if not all(MIN_SPACING_MM <= one <= MAX_SPACING_MM for one in (between_rows, between_columns)):
        what = f"{name('PixelSpacing')} is {between_rows:g}, {between_columns:g}"
        refuse(what, label, f"{MIN_SPACING_MM} to {MAX_SPACING_MM} mm", "implausible_spacing")
    if max(map(abs, cosines)) > 2:
        refuse(f"{name('ImageOrientationPatient')} is {list(cosines)}", label, "unit vectors", "not_unit")
    axes = np.array(cosines).reshape(2, 3).T
    lengths = np.linalg.norm(axes, axis=0)
    if np.abs(lengths - 1.0).max() > UNIT_TOLERANCE or abs(axes[:, 0] @ axes[:, 1]) > UNIT_TOLERANCE:
        what = f"{name('ImageOrientationPatient')} is {list(cosines)}"
        refuse(what, label, "two unit vectors at a right angle", "axes_not_square")
    row = axes[:, 0] / lengths[0]
    column = axes[:, 1] - (axes[:, 1] @ row) * row
    square = np.stack([row, column / np.linalg.norm(column)], axis=1)
    return Plane(np.array(origin), square, (between_columns, between_rows))


def _slice(file: str, frame: int, label: str, groups: Groups) -> Slice:
    rescale = groups.holder("PixelValueTransformationSequence", label)
    kind = text(rescale, "RescaleType", where=label)
    if kind not in HOUNSFIELD:
        refuse(f"{name('RescaleType')} is {kind!r}", label, "HU (Hounsfield units)", "not_hounsfield")
    for keyword in ("RescaleSlope", "RescaleIntercept"):
        if keyword not in rescale:
            what = f"{name(keyword)} is missing, so its Hounsfield units are not known"
            refuse(what, label, WITH_RESCALE, "no_rescale")
    slope, intercept = (number(rescale, keyword, where=label) for keyword in ("RescaleSlope", "RescaleIntercept"))
    if slope == 0 or abs(slope) > 1e6 or abs(intercept) > 1e6:
        what = f"rescaling by {slope:g} and {intercept:g}"
        refuse(what, label, "a slope other than 0, both within a million", "out_of_range")
    stated = [(groups.own, "AcquisitionNumber")] if groups.own is groups.shared else []
    stated += [(one, "FrameAcquisitionNumber") for one in groups.find("FrameContentSequence", label)]
    acquisition = next((text(one, keyword, where=label) for one, keyword in stated), "")
    return Slice(file, frame, label, plane_of(groups, label), slope, intercept, acquisition)


AXES_TOLERANCE = 1e-3
"""Tolerance between the axes of two slices: 0.25 mm at the corner of a slice, below a pixel; cosines are rounded."""
PLACE_TOLERANCE_MM = 0.1
"""Tolerance of a slice's place in the stack: positions that are rounded to a tenth are within 0.05."""
PLACE_TOLERANCE = 0.1
"""Tolerance of a slice's place as a fraction of the step, where that is less."""
SPACING_TOLERANCE = 1e-4
"""Relative tolerance between the pixel sizes of two slices."""
ONE_PLACE_MM = 1e-3
"""Distance within which two slices lie at one place: no scanner's are so near."""
SHOWN = 4
"""Most slices that a message names."""


@dataclass(frozen=True, eq=False)
class Stack:
    """A regular stack: slices at even steps."""

    slices: tuple[Slice, ...]  # in the order in which they lie along the normal
    plane: Plane  # the first one's
    step_ct: Floats  # shape (3,), from each slice to the next, LPS mm

    @property
    def T_ct_index(self) -> Floats:  # noqa: N802  a frame's name
        """Shape (4, 4), maps (column, row, slice) to LPS mm; sheared where the gantry was tilted."""
        T = np.eye(4)
        T[:3, :2] = self.plane.axes_ct * self.plane.spacing_mm
        T[:3, 2] = self.step_ct
        T[:3, 3] = self.plane.origin_ct
        return T


def stack_of(slices: Sequence[Slice], where: Path) -> Stack:
    """The stack that slices make.

    Raises InputError: fewer than two, other orientations or pixel sizes, several at one place, a step that is missing,
    uneven steps, or two scans whose slices lie in turns; the slices are named.
    """
    if len(slices) < 2:
        refuse(f"{len(slices)} slice", where, "a series of at least 2 slices", "too_few_slices")
    first = slices[0]
    for other in slices[1:]:
        if np.abs(first.plane.axes_ct - other.plane.axes_ct).max() > AXES_TOLERANCE:
            angle = np.degrees(np.arccos(np.clip(first.plane.normal_ct @ other.plane.normal_ct, -1.0, 1.0)))
            what = f"{first.label} and {other.label} have different orientations (normals {angle:.1f} degrees apart)"
            refuse(what, where, "slices of the same orientation", "mixed_geometry")
        if np.abs(np.array(first.plane.spacing_mm) / other.plane.spacing_mm - 1.0).max() > SPACING_TOLERANCE:
            what = f"{first.label} and {other.label} have different pixel sizes"
            refuse(f"{what}: {first.plane.spacing_mm} and {other.plane.spacing_mm} mm", where, "one", "mixed_geometry")
    normal = first.plane.normal_ct
    ordered = sorted(slices, key=lambda one: float(one.plane.origin_ct @ normal))
    origins = np.array([one.plane.origin_ct for one in ordered])
    steps = np.diff(origins @ normal)
    _check_one_place(ordered, steps, where)
    step = float(np.median(steps))
    wrong = np.flatnonzero(np.abs(steps - step) > _tolerance(step))
    if len(wrong):
        at = int(wrong[0])
        between, times = f"between {ordered[at].label} and {ordered[at + 1].label}", steps[at] / step
        what = f"uneven steps: {steps[at]:.4g} mm {between}"
        if round(times) >= 2 and abs(times - round(times)) * step <= _tolerance(step):
            missing = round(times) - 1
            what = f"{missing} slice{' is' if missing == 1 else 's are'} missing {between}: {steps[at]:.4g} mm apart"
        more = f", and at {len(wrong) - 1} more places" if len(wrong) > 1 else ""
        allowed = f"even steps; here mostly {step:.4g} mm (resample the series, or export it again)"
        refuse(f"{what}{more}", where, allowed, "uneven_slices")
    _check_one_scan(ordered, where)
    step_ct = (origins[-1] - origins[0]) / (len(ordered) - 1)
    off = np.linalg.norm(origins - origins[0] - np.arange(len(ordered))[:, None] * step_ct, axis=1)
    worst = int(np.argmax(off))
    if off[worst] > _tolerance(step):
        what = f"{ordered[worst].label} lies {off[worst]:.2f} mm off the line of the others"
        refuse(what, where, f"slices along one straight line, to {_tolerance(step):.2g} mm", "off_grid")
    return Stack(tuple(ordered), ordered[0].plane, step_ct)


def _check_one_place(ordered: Sequence[Slice], steps: Floats, where: Path) -> None:
    """Refuse slices at one place: nearer than a tenth of the usual step; a gap makes others no nearer."""
    apart = steps[steps >= ONE_PLACE_MM]
    near = steps < (max(ONE_PLACE_MM, PLACE_TOLERANCE * float(np.quantile(apart, 0.75))) if len(apart) else np.inf)
    if not near.any():
        return
    named = [f"{ordered[k].label} and {ordered[k + 1].label}" for k in np.flatnonzero(near).tolist()]
    more = f" and {len(named) - SHOWN} more pairs" if len(named) > SHOWN else ""
    allowed = "one slice at each position (one time point, no copies)"
    refuse(f"several slices at one position: {'; '.join(named[:SHOWN])}{more}", where, allowed, "duplicate_place")


def _check_one_scan(ordered: Sequence[Slice], where: Path) -> None:
    """Refuse two scans that lie in turns: the patient breathed between them, and neither shows what is between its own.

    One that is scanned in parts has them one behind the other; a number that stands in one place alone is a slip.
    """
    starts = [one for before, one in pairwise(ordered) if one.acquisition != before.acquisition]
    runs = Counter(one.acquisition for one in (ordered[0], *starts))
    again = [number for number, count in runs.items() if number and count > 1]
    if len(again) > 1:
        first, second = (next(one.label for one in ordered if one.acquisition == number) for number in again[:2])
        what = f"slices of {len(again)} acquisitions lie in turns, such as {first} and {second}"
        refuse(what, where, "one acquisition: move the other's files elsewhere", "several_acquisitions")


def _tolerance(step: float) -> float:
    return min(PLACE_TOLERANCE_MM, PLACE_TOLERANCE * step)


NO_TILT_MM = 0.05
"""mm of shift from the first slice to the last: less is the rounding of positions."""
MAX_TILT_DEG = 45.0
"""Gantries tilt to 30 degrees; beyond, the slices are no stack."""
WHOLE_PIXEL = 1e-6
"""Fraction of a pixel: a shift so near to a whole number of pixels needs no interpolation."""


@dataclass(frozen=True, eq=False)
class StraightGrid:
    """The grid with right angles that holds every slice of a stack."""

    shape: tuple[int, int, int]  # voxels along columns, rows and slices
    T_ct_index: Floats  # shape (4, 4), maps them to LPS mm
    shifts: Floats  # shape (n, 2), where pixel (0, 0) of each slice lies in the grid, along columns and rows, in pixels
    tilt_deg: float  # between the slices' normal and the direction from one to the next


def straight_grid(stack: Stack, rows: int, columns: int, where: Path) -> StraightGrid:
    """The grid of a stack; its own where it was not tilted. Raises InputError: slices that lie side by side."""
    plane, count = stack.plane, len(stack.slices)
    along = float(stack.step_ct @ plane.normal_ct)
    sideways_mm = plane.axes_ct.T @ stack.step_ct  # how far each slice is shifted in its own plane
    tilt = float(np.degrees(np.arctan2(np.linalg.norm(sideways_mm), along)))
    if tilt > MAX_TILT_DEG:
        what = f"the slice normal and the direction from slice to slice are {tilt:.0f} degrees apart"
        refuse(what, where, f"a tilt of at most {MAX_TILT_DEG:g} degrees", "gantry_tilt")
    if np.linalg.norm(sideways_mm) * (count - 1) <= NO_TILT_MM:
        sideways_mm, tilt = np.zeros(2), 0.0
    shifts = np.arange(count)[:, None] * (sideways_mm / plane.spacing_mm)
    low, high = np.floor(shifts.min(axis=0) + WHOLE_PIXEL), np.ceil(shifts.max(axis=0) - WHOLE_PIXEL)
    T = stack.T_ct_index
    T[:3, 2] = along * plane.normal_ct
    T[:3, 3] += T[:3, :2] @ low  # its corner moves with the least shift
    size = (high - low).astype(int) + (columns, rows)
    return StraightGrid((int(size[0]), int(size[1]), count), T, shifts - low, tilt)


def moved(image: NDArray[np.float32], shift: Floats, shape: tuple[int, int]) -> NDArray[np.float32]:
    """An image (columns, rows), NaN where unmeasured, in a larger one of a shape, NaN outside of it.

    ``shift``: where its pixel (0, 0) lies in the larger one, along each axis; 0 or more.
    """
    for axis in (0, 1):
        near = int(np.floor(shift[axis] + WHOLE_PIXEL))
        part = float(shift[axis]) - near
        placed = _placed(image, near, shape[axis], axis)
        if part > WHOLE_PIXEL:
            beyond = _placed(image, near + 1, shape[axis], axis)
            placed = np.float32(1.0 - part) * placed + np.float32(part) * beyond
        image = placed
    return image


def _placed(image: NDArray[np.float32], at: int, size: int, axis: int) -> NDArray[np.float32]:
    pads = [(0, 0), (0, 0)]
    pads[axis] = (at, size - at - image.shape[axis])
    return np.pad(image, pads, constant_values=np.nan)
