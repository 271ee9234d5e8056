"""DICOM RTSTRUCT: contours as masks on the slices of the CT on which they were drawn (PS3.3, C.8.8.5 and C.8.8.6)."""

import itertools
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from pydicom.dataelem import RawDataElement
from pydicom.dataset import Dataset
from skimage.morphology import convex_hull_image

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.text import first_few
from puncture_twin.planning.formats.dicom import dicom_file, named_masks
from puncture_twin.planning.formats.dicom.ct_series import CtSeries
from puncture_twin.planning.formats.dicom.storage import STRUCTURE_SET
from puncture_twin.planning.formats.volumes.volume_files import Content
from puncture_twin.planning.formats.volumes.volume_header import MAX_ORIGIN_MM, VolumeGrid, check_shape
from puncture_twin.planning.geometry.rigid import apply

CLOSED = ("CLOSED_PLANAR", "CLOSEDPLANAR_XOR")
"""Contours that enclose an area; one within another leaves it out."""
ON_SLICE = 0.1
"""Fraction of the step by which a contour may miss its slice."""
MAX_CONTOUR_POINTS = 100_000
"""Most points of a contour: an image of 1000 pixels has 4000 around it."""
LEAN = 1.5
"""Parts in the two slices about a gap are one where they lie no farther apart sideways than so often its height: what
leans by 60 degrees and is thin."""
OVERLAP = 0.5
"""Parts that overlap by less of the smaller one lean: both together would be pinched in the middle between them."""
GAPS = (
    "slices without a contour, between two with one, were filled where both overlap, lie near each other or all are "
    "evenly spaced, and otherwise left empty, in"
)
MAX_LENGTH = 5_000_000
"""Most pixels along one contour; the finest line through every pixel of an image has fewer."""


@dataclass(frozen=True, eq=False)
class Contour:
    """A closed contour in a slice."""

    slice: int  # its number in the CT
    points: Floats  # shape (n, 2), columns and rows, in pixels


@dataclass(frozen=True, eq=False)
class _Region:
    """A region of interest: its closed contours, and how many others it has."""

    contours: tuple[Contour, ...]
    others: int


def parse_structure_set(path: Path, file: str, content: Content, ct: CtSeries) -> named_masks.NamedMasks:
    """The regions of an RTSTRUCT, each by its name, on the slices of a CT; ``file`` is its key in ``content``.

    A slice between two contoured ones is filled with what either of them encloses, where they overlap, and with the
    hull of parts that lie near each other: programs leave slices out and interpolate, and a gap in an organ would count
    as free. What encloses no pixel's centre counts for
    the pixels along it. Both are noted.

    Raises:
        InputError: No trusted structure set, of another frame of reference, or with contours off the CT's slices.
    """
    data = dicom_file.parse_dicom(content(file), path)
    where = path.name
    if (sop_class := dicom_file.sop_class_of(data, where=where)) != STRUCTURE_SET:
        refuse(f"SOP class {sop_class or 'missing'}", path, "a DICOM RTSTRUCT", "wrong_format")
    names = _names(data, ct, path)
    named_masks.unique_names(list(names.values()), path)
    grid = VolumeGrid(check_shape((*ct.slice_shape, len(ct.stack.slices)), where=ct.path), ct.stack.T_ct_index, {})
    regions = _regions(data, names, grid, path)
    files = (file, *ct.files)
    masks = {
        called: named_masks.MaskVolume(path, files, (called,), grid, partial(_mask, regions[roi].contours, grid))
        for roi, called in names.items()
    }
    notes = _notes({names[roi]: region for roi, region in regions.items()}, grid, where)
    return named_masks.NamedMasks(masks, tuple(notes))


def _names(data: Dataset, ct: CtSeries, path: Path) -> dict[int, str]:
    names: dict[int, str] = {}
    for item in dicom_file.items(data, "StructureSetROISequence", where=path.name):
        roi = dicom_file.whole(item, "ROINumber", low=-(2**31), high=2**31 - 1, where=path.name)
        if roi in names:
            refuse(f"two regions have the number {roi}", path, "each number once", "duplicate_number")
        frame = dicom_file.text(item, "ReferencedFrameOfReferenceUID", where=path.name)
        named_masks.check_frame_of_reference(frame, ct, path)
        names[roi] = dicom_file.text(item, "ROIName", where=path.name)
    return names


def _regions(data: Dataset, names: dict[int, str], grid: VolumeGrid, path: Path) -> dict[int, _Region]:
    regions: dict[int, _Region] = {}
    if "ROIContourSequence" not in data:
        what = f"{dicom_file.name('ROIContourSequence')} is missing: was the file cut?"
        refuse(what, path, "contours", "missing_tag")
    T_index_ct = np.asarray(np.linalg.inv(grid.T_ct_index), np.float64)
    for item in dicom_file.items(data, "ROIContourSequence", where=path.name):
        roi = dicom_file.whole(item, "ReferencedROINumber", low=-(2**31), high=2**31 - 1, where=path.name)
        if roi not in names or roi in regions:
            what = f"contours of region {roi}, which is {'listed twice' if roi in regions else 'not listed'}"
            refuse(what, path, "one list of contours for each region", "unknown_region")
        label = f"{path.name}, {names[roi]!r}"
        listed = dicom_file.items(item, "ContourSequence", where=label)
        closed = [one for one in listed if dicom_file.text(one, "ContourGeometricType", where=label) in CLOSED]
        contours = tuple(_contour(one, T_index_ct, grid, label) for one in closed)
        regions[roi] = _Region(contours, len(listed) - len(closed))
    return {roi: regions.get(roi, _Region((), 0)) for roi in names}


def _contour(item: Dataset, T_index_ct: Floats, grid: VolumeGrid, label: str) -> Contour:
    with dicom_file.refused_if_damaged(f"{label}: {dicom_file.name('ContourData')}"):
        raw = item.get_item("ContourData")
        stored = raw.value if isinstance(raw, RawDataElement) else None
        parts = bytes(stored or b"").rstrip(b" \0").split(b"\\")
        flat = np.array(parts, dtype=np.float64) if parts != [b""] else np.zeros(0)
    count = len(flat) // 3
    if len(flat) != 3 * count or not 1 <= count <= MAX_CONTOUR_POINTS or not (np.abs(flat) <= MAX_ORIGIN_MM).all():
        allowed = "three finite numbers for each of its points"
        refuse(f"{dicom_file.name('ContourData')} has {len(flat)} numbers", label, allowed, "wrong_count")
    if "NumberOfContourPoints" in item:
        dicom_file.whole(item, "NumberOfContourPoints", low=count, high=count, where=label)
    points_ct = flat.reshape(-1, 3)
    index = apply(T_index_ct, points_ct)
    slices = np.unique(np.round(index[:, 2]))
    at = points_ct[0].round(2).tolist()
    if len(slices) != 1 or np.abs(index[:, 2] - slices[0]).max() > ON_SLICE:
        what = f"the contour through {at} lies between the CT's slices"
        refuse(what, label, "contours in the slices of their CT", "contour_outside_ct")
    if not 0 <= slices[0] < grid.shape[2]:
        what = f"the contour through {at} lies beyond the CT's slices"
        refuse(what, label, "contours within their CT", "contour_outside_ct")
    length = float(np.abs(index[:, :2] - np.roll(index[:, :2], 1, axis=0)).sum())
    if length > MAX_LENGTH:
        refuse(f"the contour through {at} is {length:.3g} pixels long", label, f"{MAX_LENGTH}", "too_long")
    return Contour(int(slices[0]), index[:, :2])


def _mask(contours: tuple[Contour, ...], grid: VolumeGrid) -> named_masks.Mask:
    mask = np.zeros(grid.shape, np.uint8, order="F")
    for number in {one.slice for one in contours}:
        mask[:, :, number] = _slice_mask([one for one in contours if one.slice == number], grid.shape[:2])
    # Whether at least three slices have contours, all at one distance of several slices
    steps = {above - below for below, above in itertools.pairwise(_slices(contours))}
    even = len(_slices(contours)) > 2 and len(steps) == 1 and steps != {1}
    for below, above in _gaps(contours):
        near = LEAN * (above - below) * grid.spacing_mm[2] / grid.spacing_mm[:2]
        between = _between(mask[:, :, below] > 0, mask[:, :, above] > 0, near, even=even)
        mask[:, :, below + 1 : above] = between[:, :, None]
    return mask


def _between(below: Bools, above: Bools, near: Floats, *, even: bool) -> Bools:
    """Masks of left-out slices: what either neighbour encloses where they overlap, and between parts of both.

    What leans too much to overlap goes on between them: within the convex hull of two parts that are so near, pixels
    (2,), or of all where it is drawn in every so-many slices (``even``).
    """
    overlap = bool((below & above).any())
    if even and not overlap:
        return np.asarray(convex_hull_image(below | above))
    between = below | above if overlap else np.zeros_like(below)
    lower, upper = _parts(below), _parts(above)
    for number, (low, high) in enumerate(zip(lower.low, lower.high, strict=True), start=1):
        apart = np.maximum(np.maximum(upper.low - high, low - upper.high), 0)
        for k in np.flatnonzero(np.linalg.norm(apart / near, axis=1) <= 1.0).tolist():
            first, last = np.minimum(low, upper.low[k]), np.maximum(high, upper.high[k])
            box = slice(first[0], last[0] + 1), slice(first[1], last[1] + 1)
            one, other = lower.numbers[box] == number, upper.numbers[box] == k + 1
            if np.count_nonzero(one & other) < OVERLAP * min(np.count_nonzero(one), np.count_nonzero(other)):
                between[box] |= convex_hull_image(one | other)
    return between


class _Parts(NamedTuple):
    """The n connected parts of a slice."""

    numbers: NDArray[np.int32]  # of each pixel's part, from 1; 0 outside
    low: NDArray[np.int64]  # shape (n, 2), the first pixel of each
    high: NDArray[np.int64]  # shape (n, 2), its last


def _parts(pixels: Bools) -> _Parts:
    numbers, _ = scipy.ndimage.label(pixels, np.ones((3, 3)))
    ends = np.array([[[at.start, at.stop - 1] for at in box] for box in scipy.ndimage.find_objects(numbers)], np.int64)
    low, high = np.moveaxis(ends.reshape(-1, 2, 2), 2, 0)
    return _Parts(numbers, low, high)


def _slice_mask(contours: list[Contour], shape: tuple[int, int]) -> Bools:
    """Pixels inside contours, and those along what is too narrow to enclose a centre.

    A contour within another is a hole if a pixel of the other is left all around it. Copies of a contour, and contours
    that overlap in part, enclose what any of them does: by an odd count they would erase each other.
    """
    inside, narrow = np.zeros(shape, bool), np.zeros(shape, bool)
    fills = [polygon_fill(contour.points, shape) for contour in contours]
    for filled in sorted(fills, key=np.count_nonzero, reverse=True):
        inside = inside & ~filled if not (grown(filled) & ~inside).any() else inside | filled
    for contour, filled in zip(contours, fills, strict=True):
        narrow |= _narrow_parts(contour.points, filled)
    return inside | narrow


def _narrow_parts(points: Floats, filled: Bools) -> Bools:
    """The pixels along a contour off the parts that it fills at least two wide, and those that join them to it."""
    start, end = points, np.roll(points, -1, axis=0)
    count = 2 * np.ceil(np.abs(end - start).max(axis=1)).astype(int) + 1
    edge = np.repeat(np.arange(len(points)), count)
    along = (np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)) / count[edge]
    at = np.round(start[edge] + along[:, None] * (end - start)[edge]).astype(int)
    at = at[((at >= 0) & (at < filled.shape)).all(axis=1)]
    passed = np.zeros_like(filled)
    passed[at[:, 0], at[:, 1]] = True
    opened = scipy.ndimage.binary_opening(filled, np.ones((2, 2)))
    return passed & grown(passed & ~grown(opened))


def grown(pixels: Bools) -> Bools:
    """Pixels and their eight neighbours."""
    return np.asarray(scipy.ndimage.maximum_filter(pixels.view(np.uint8), 3, mode="constant").view(bool))


def _gaps(contours: tuple[Contour, ...]) -> list[tuple[int, int]]:
    """Neighbouring slices with contours that leave slices without any between them."""
    return [(below, above) for below, above in itertools.pairwise(_slices(contours)) if above - below > 1]


def _slices(contours: tuple[Contour, ...]) -> list[int]:
    """The numbers of the slices that have contours, rising."""
    return sorted({one.slice for one in contours})


def _notes(regions: dict[str, _Region], grid: VolumeGrid, where: str) -> list[str]:
    size = np.array(grid.shape[:2])
    points = {called: [one.points for one in region.contours] for called, region in regions.items()}
    cut = [c for c, some in points.items() if any((p < -0.5).any() or (p > size - 0.5).any() for p in some)]
    small = [c for c, some in points.items() if any(_is_tiny(one, grid.shape[:2]) for one in some)]
    gaps = [called for called, region in regions.items() if _gaps(region.contours)]
    others = [called for called, region in regions.items() if region.others]
    findings = (
        (others, "contours that are not closed (points, lines) were left out of"),
        (gaps, GAPS),
        (small, "contours smaller than a pixel count as the pixels along them, in"),
        (cut, "contours that reach beyond the CT's image end there, in"),
    )
    return [f"{where}: {problem} {first_few(some)}" for some, problem in findings if some]


def _is_tiny(points: Floats, shape: tuple[int, int]) -> bool:
    """Whether a contour encloses no pixel's centre; one that is wide in both directions is not tried."""
    narrow = (points.max(axis=0) - points.min(axis=0)).min() < 2.0
    return bool(narrow) and not polygon_fill(points, shape).any()


def polygon_fill(points: Floats, shape: tuple[int, int]) -> Bools:
    """Pixels (ni, nj) inside a closed polygon (n, 2), where (i, j) is the centre of a pixel; what lies outside is cut.

    A centre is inside if the edges that a ray from it along the first axis crosses upward and downward differ in
    number: what is traced twice is inside still, where an odd count would leave it out, and a channel of no width
    (a keyhole) encloses nothing. Each edge holds its lower end and not its upper one: a vertex is counted once.
    """
    ni, nj = shape
    start, end = points, np.roll(points, -1, axis=0)
    down = (start[:, 1] > end[:, 1])[:, None]
    low, high = np.where(down, end, start), np.where(down, start, end)
    first, last = (np.clip(np.ceil(one[:, 1]), 0, nj).astype(int) for one in (low, high))
    crossed = last - first
    edge = np.repeat(np.arange(len(points)), crossed)
    j = np.arange(len(edge)) - np.repeat(np.cumsum(crossed) - crossed - first, crossed)
    slope = (high[edge, 0] - low[edge, 0]) / (high[edge, 1] - low[edge, 1])
    i = np.clip(np.ceil(low[edge, 0] + (j - low[edge, 1]) * slope), 0, ni).astype(int)
    winding = np.where(down[edge, 0], -1.0, 1.0)
    crossings = np.bincount(i * nj + j, winding, minlength=(ni + 1) * nj).reshape(ni + 1, nj)
    return np.asarray(np.cumsum(crossings[:ni], axis=0) != 0)
