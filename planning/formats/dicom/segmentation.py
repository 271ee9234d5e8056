"""DICOM SEG: segments as masks, which may overlap (DICOM PS3.3, A.51 and C.8.20)."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydicom.dataset import Dataset

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.formats.dicom import dicom_file, named_masks, slices
from puncture_twin.planning.formats.dicom.ct_series import CtSeries
from puncture_twin.planning.formats.dicom.pixels import check_length, sizes
from puncture_twin.planning.formats.dicom.slices import PLACE_TOLERANCE, Groups, Plane
from puncture_twin.planning.formats.dicom.storage import PLAIN, SEGMENTATION
from puncture_twin.planning.formats.volumes.volume_files import Content
from puncture_twin.planning.formats.volumes.volume_header import MAX_SPACING_MM, MIN_SPACING_MM, VolumeGrid, check_shape

MAX_SLICES = 20_000
"""Most slices from the first to the last frame."""
ON_GRID = 0.05
"""Fraction of a voxel by which a segmentation's grid may miss the CT's and still be on it."""
HALF = 0.5
"""From this fraction on, a voxel of a fractional segment belongs to it."""


@dataclass(frozen=True, eq=False)
class _Frames:
    """The frames of a segmentation."""

    segments: NDArray[np.int64]  # shape (n,), the segment of each frame
    steps: NDArray[np.int64]  # shape (n,), where it lies, in steps from the first
    T_ct_index: Floats  # shape (4, 4), maps (column, row, slice) to LPS mm
    rows: int
    columns: int


@dataclass(frozen=True, eq=False)
class _Placed:
    """The grid on which the masks are made, and its slice in which the first frame lies."""

    grid: VolumeGrid
    first: int


def parse_segmentation(path: Path, file: str, content: Content, ct: CtSeries | None) -> named_masks.NamedMasks:
    """The segments of a DICOM SEG, each by its label; ``file`` is its key in ``content``.

    Args:
        ct: The CT on which it was drawn, where that is DICOM too: masks lie on its grid where they fit it.

    Raises:
        InputError: No segmentation, one that cannot be trusted, or one of another frame of reference.
    """
    data = dicom_file.parse_dicom(content(file), path)
    where = path.name
    if (sop_class := dicom_file.sop_class_of(data, where=where)) != SEGMENTATION:
        refuse(f"SOP class {sop_class or 'missing'}", path, "a DICOM SEG", "wrong_format")
    kind = _checked_kind(data, path)
    if ct is not None:
        named_masks.check_frame_of_reference(dicom_file.text(data, "FrameOfReferenceUID", where=where), ct, path)
    names: dict[int, str] = {}
    for item in dicom_file.items(data, "SegmentSequence", where=where):
        segment = dicom_file.whole(item, "SegmentNumber", low=1, high=65535, where=where)
        if segment in names:
            refuse(f"two segments have the number {segment}", where, "each number once", "duplicate_number")
        names[segment] = dicom_file.text(item, "SegmentLabel", where=where)
    named_masks.unique_names(list(names.values()), path)
    frames = _frames(data, names, ct, path)
    placed = _placed(data, frames, ct, path)
    files = (file,) if ct is None else (file, *ct.files)
    masks = {}
    for segment, called in names.items():
        make = partial(_mask, data, frames, placed, segment, path)
        masks[called] = named_masks.MaskVolume(path, files, (called,), placed.grid, make)
    notes = [] if ct else [f"{where}: the case's CT is not a DICOM series, so this may belong to another CT"]
    if kind == "FRACTIONAL":
        notes.append(f"{where}: fractional segments; voxels of {HALF:g} or more count")
    return named_masks.NamedMasks(masks, tuple(notes))


def _checked_kind(data: Dataset, path: Path) -> str:
    where = path.name
    kind = dicom_file.text(data, "SegmentationType", where=where)
    if kind not in ("BINARY", "FRACTIONAL"):
        what = f"{dicom_file.name('SegmentationType')} is {kind or 'missing'}"
        refuse(what, path, "BINARY, FRACTIONAL", "unsupported_feature")
    if data.file_meta.TransferSyntaxUID not in PLAIN:
        dicom_file.refuse_syntax(data.file_meta.TransferSyntaxUID, path)
    bits = 1 if kind == "BINARY" else 8
    dicom_file.whole(data, "BitsAllocated", low=bits, high=bits, where=where)
    rows, columns, count = sizes(data, where)
    check_length(data, (rows * columns * count * bits + 7) // 8, where)
    return kind


def _frames(data: Dataset, names: dict[int, str], ct: CtSeries | None, path: Path) -> _Frames:
    where = path.name
    rows, columns, count = sizes(data, where)
    groups = slices.frame_groups(data, count, where=where)
    segments = np.array([_segment(one, f"{where}, frame {k + 1}", names) for k, one in enumerate(groups)])
    planes = [slices.plane_of(one, f"{where}, frame {k + 1}") for k, one in enumerate(groups)]
    T, steps = _regular(planes, _stated_step(groups[0], where, ct), path)
    if len(set(zip(segments.tolist(), steps.tolist(), strict=True))) < count:
        refuse("two frames of one segment are at the same position", path, "one frame per slice", "duplicate_place")
    return _Frames(segments, steps, T, rows, columns)


def _segment(groups: Groups, label: str, names: dict[int, str]) -> int:
    holder = groups.find("SegmentIdentificationSequence", label)
    if len(holder) != 1:
        refuse(f"{len(holder)} items state its segment", label, "one", "wrong_count")
    segment = dicom_file.whole(holder[0], "ReferencedSegmentNumber", low=1, high=65535, where=label)
    if segment not in names:
        refuse(f"is of segment {segment}, which is not listed", label, f"{sorted(names)}"[:200], "unknown_segment")
    return segment


def _stated_step(groups: Groups, where: str, ct: CtSeries | None) -> float | None:
    """Distance of slices by header or CT, mm; not the slice thickness, which may be thinner."""
    measures = groups.holder("PixelMeasuresSequence", where)
    if "SpacingBetweenSlices" in measures:
        step = dicom_file.number(measures, "SpacingBetweenSlices", where=where)
    elif ct is not None:
        step = float(ct.stack.step_ct @ ct.stack.plane.normal_ct)
    elif "SliceThickness" in measures:
        step = dicom_file.number(measures, "SliceThickness", where=where)
    else:
        return None
    return step if MIN_SPACING_MM <= step <= MAX_SPACING_MM else None


def _regular(planes: list[Plane], stated_mm: float | None, path: Path) -> tuple[Floats, NDArray[np.int64]]:
    """The affine of the frames' own grid, and the slice of each frame; frames that are left out are empty."""
    first = planes[0]
    for other in planes[1:]:
        rotated = np.abs(other.axes_ct - first.axes_ct).max() > slices.AXES_TOLERANCE
        if rotated or not np.allclose(other.spacing_mm, first.spacing_mm, rtol=slices.SPACING_TOLERANCE):
            refuse("its frames have several orientations or pixel sizes", path, "one of each", "mixed_geometry")
    origins = np.array([plane.origin_ct for plane in planes])
    along = origins @ first.normal_ct
    order = np.argsort(along, kind="stable")
    low, high = origins[order[0]], origins[order[-1]]
    step = _least_step(np.diff(along[order]), stated_mm, path)
    count = round(float((along[order[-1]] - along[order[0]]) / step))
    if count > MAX_SLICES:
        refuse(f"{count} slices from its first to its last frame", path, f"{MAX_SLICES}", "too_many")
    step_ct = (high - low) / count if count else step * first.normal_ct
    steps = np.round((along - along[order[0]]) / step).astype(np.int64)
    off = np.linalg.norm(origins - low - steps[:, None] * step_ct, axis=1)
    if off.max() > PLACE_TOLERANCE * step:
        what = f"frame {int(np.argmax(off)) + 1} lies {off.max():.2f} mm off the grid of the others"
        refuse(what, path, f"frames at whole steps of {step:.4g} mm along one line", "off_grid")
    T = np.eye(4)
    T[:3, :2], T[:3, 2], T[:3, 3] = first.axes_ct * first.spacing_mm, step_ct, low
    return T, steps


def _least_step(gaps: Floats, stated_mm: float | None, path: Path) -> float:
    """The distance of neighbouring slices, mm: the least of the frames, where all keep to it, else the stated one.

    A stated distance that no two frames have would leave an empty slice between any two, and an organ full of gaps.
    """
    real = gaps[gaps > 1e-3]
    if not len(real):
        if stated_mm is None:
            refuse("one slice of unknown thickness", path, "SliceThickness", "missing_tag")
        return stated_mm
    least = float(real.min())
    uneven = (np.abs(real - np.round(real / least) * least) > PLACE_TOLERANCE * least).any()
    if uneven and stated_mm is not None and stated_mm <= least * (1 + PLACE_TOLERANCE):
        times = round(least / stated_mm)
        if abs(least - times * stated_mm) <= PLACE_TOLERANCE * stated_mm:
            return least / times
    return least


def _placed(data: Dataset, frames: _Frames, ct: CtSeries | None, path: Path) -> _Placed:
    """The masks' grid: the CT's own slices where the frames lie on them, else a grid of their own.

    Slices without a frame are empty. But frames that are smaller than a slice say nothing of what lies beside them, and
    a file that states empty frames left none out, so nothing of slices beyond: the grid ends where they end.
    """
    own = (frames.columns, frames.rows, int(frames.steps.max()) + 1)
    if ct is not None:
        T_ct_slices, shape = ct.stack.T_ct_index, (*ct.slice_shape, len(ct.stack.slices))
        between = np.linalg.inv(T_ct_slices) @ frames.T_ct_index
        offset = np.round(between[:3, 3]).astype(int)
        reach = np.abs(between[:3, :3] - np.eye(3)) @ np.array(own) + np.abs(between[:3, 3] - offset)
        if reach.max() <= ON_GRID + PLACE_TOLERANCE and (offset >= 0).all() and (offset + own <= shape).all():
            whole = own[2] < 2 or not _states_empty_frames(data, frames, path)
            count, first = (shape[2], int(offset[2])) if whole else (own[2], 0)
            T_ct_slices[:3, 3] += T_ct_slices[:3] @ [*offset[:2], offset[2] - first, 0]
            return _Placed(VolumeGrid((*own[:2], count), T_ct_slices, {}), first)
    return _Placed(VolumeGrid(check_shape((*own[:2], max(own[2], 2)), where=path), frames.T_ct_index, {}), 0)


def _states_empty_frames(data: Dataset, frames: _Frames, path: Path) -> bool:
    """Whether a frame in the first or the last slice is empty."""
    at_ends = np.flatnonzero((frames.steps == 0) | (frames.steps == frames.steps.max())).tolist()
    return any(not _image(data, frame, frames.rows, frames.columns, path).any() for frame in at_ends)


def _mask(data: Dataset, frames: _Frames, placed: _Placed, segment: int, path: Path) -> named_masks.Mask:
    mask = np.zeros(placed.grid.shape, np.uint8, order="F")
    for frame in np.flatnonzero(frames.segments == segment).tolist():
        image = _image(data, frame, frames.rows, frames.columns, path)
        mask[:, :, placed.first + int(frames.steps[frame])] = image.T
    return mask


def _image(data: Dataset, frame: int, rows: int, columns: int, path: Path) -> named_masks.Mask:
    """One frame, shape (rows, columns), 0 and 1; bits are packed over frames without a gap, the lowest first."""
    count = rows * columns
    if dicom_file.text(data, "SegmentationType", where=path.name) == "FRACTIONAL":
        highest = dicom_file.whole(data, "MaximumFractionalValue", low=1, high=255, where=path.name)
        cells = np.frombuffer(data.PixelData, np.uint8, count, frame * count)
        return (cells >= HALF * highest).astype(np.uint8).reshape(rows, columns)
    first, last = frame * count // 8, ((frame + 1) * count + 7) // 8
    bits = np.unpackbits(np.frombuffer(data.PixelData, np.uint8, last - first, first), bitorder="little")
    start = frame * count - 8 * first
    return bits[start : start + count].reshape(rows, columns)
