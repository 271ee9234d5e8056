"""A result as DICOM objects for the archive that holds the scan: regions as a segmentation, numbers as a report.

The segmentation (SEG) lies on the scan's own slices. The report (Comprehensive 3D SR) holds lines and points in the
scan's frame of reference, numbers with units, and sentences. Patient and study are the scan's. Both are read back and
compared with what was to be written before anything is published.
"""

import hashlib
import io
import itertools
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydicom import dcmread
from pydicom.dataset import Dataset
from pydicom.sr.coding import Code
from pydicom.uid import generate_uid

from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.errors import refuse, require_extra
from puncture_twin.planning.formats.dicom.ct_series import CtSeries
from puncture_twin.planning.formats.dicom.dicom_file import parse_dicom
from puncture_twin.planning.formats.dicom.segmentation import parse_segmentation
from puncture_twin.planning.geometry.rigid import apply

DICOM = "dicom"
"""Name of the format ``dicom``."""
SEGMENTS, REPORT = "segments.dcm", "report.dcm"
NAMES = (SEGMENTS, REPORT)
MAKER = "puncture_twin"
SCHEME = "99PUNCTURETWIN"
"""Coding scheme of the codes that no public scheme has."""
KINDS: Mapping[str, tuple[Code, Code]] = {
    "skin": (Code("91723000", "SCT", "Anatomical Structure"), Code("39937001", "SCT", "Skin structure")),
    "needle": (Code("49062001", "SCT", "Device"), Code("79068005", "SCT", "Needle, device")),
}
"""Category and type of the segment, by the kind of a region."""
UNITS = {"mm": "mm", "deg": "deg", "mm2": "mm2", "deg2": "deg2", "s": "s", "": "1"}
"""Units of quantities, as UCUM writes them."""
TYPE_2 = (
    *("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime", "StudyID"),
    *("AccessionNumber", "ReferringPhysicianName"),
)
"""A slice that leaves one of these out gives it as empty: DICOM allows both to be unknown."""
WHOSE = ("PatientID", "PatientName", "PatientBirthDate", "StudyInstanceUID")
"""Elements in which all slices must agree."""


class Region(NamedTuple):
    """A region that becomes one segment: every voxel that holds one of its points."""

    name: str
    kind: str  # one of `KINDS`
    points_ct: Floats  # shape (n, 3), LPS mm, denser than the voxels


class Quantity(NamedTuple):
    """A number of the report; its unit is one of `UNITS`."""

    name: str
    value: float
    unit: str


@dataclass(frozen=True, eq=False)
class ArchiveContent:
    """Content of the archive: lines of one or several points (n, 3), LPS mm, and sentences by their headings."""

    title: str
    regions: tuple[Region, ...]
    lines: Mapping[str, Floats]
    quantities: tuple[Quantity, ...]
    sentences: tuple[tuple[str, str], ...]


def archive_files(scan: CtSeries, content: ArchiveContent) -> dict[str, bytes]:
    """The segmentation and the report, by their names.

    Raises:
        InputError: A scan without a frame of reference, of several patients or multi-frame files, a region outside,
            or highdicom is not installed.
    """
    if not scan.frame_of_reference:
        what = "the scan states no frame of reference: nothing can refer to its coordinates"
        refuse(what, scan.path, "a series as the scanner exports it", "no_frame_of_reference")
    sources = _sources(scan)
    masks = [_mask(scan, region) for region in content.regions]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*person name")  # the scan's patient may have one name alone
        files = {
            SEGMENTS: _bytes(_segmentation(sources, scan, content, masks)),
            REPORT: _bytes(_report(sources, scan, content)),
        }
    _check_segments(files[SEGMENTS], scan, content.regions, masks)
    _check_report(files[REPORT], content)
    return files


def _sources(scan: CtSeries) -> list[Dataset]:
    """The scan's files in the order of the stack, complete in what every object of its study must repeat."""
    names = list(dict.fromkeys(one.file for one in scan.stack.slices))
    data = [parse_dicom(scan.content(name), Path(name)) for name in names]
    if len({tuple(str(one.get(name, "")) for name in WHOSE) for one in data}) > 1:
        what = "its slices name several patients or studies: the objects could belong to the wrong one"
        refuse(what, scan.path, "slices of one patient and study", "several_patients")
    if len(data) > 1 and any(int(one.get("NumberOfFrames", 1)) > 1 for one in data):
        allowed = "one multi-frame file, or slices of one file each"
        refuse("several multi-frame files: no segmentation refers to them", scan.path, allowed, "many_multi_frame")
    step = float(np.linalg.norm(scan.stack.step_ct))
    for number, one in enumerate(data, start=1):
        for keyword in (name for name in TYPE_2 if name not in one):
            setattr(one, keyword, "")
        if not one.get("InstanceNumber"):
            one.InstanceNumber = number
        if not one.get("SliceThickness") and "SharedFunctionalGroupsSequence" not in one:
            one.SliceThickness = f"{step:.6g}"
    return data


def _mask(scan: CtSeries, region: Region) -> Bools:
    """Voxels of the scan's own slices that hold a point of a region, shape (columns, rows, slices)."""
    stack, shape = scan.stack, (*scan.slice_shape, len(scan.stack.slices))
    at = np.rint(apply(np.linalg.inv(stack.T_ct_index), region.points_ct)).astype(int)
    at = at[((at >= 0) & (at < shape)).all(axis=1)]
    if not len(at):
        refuse(f"'{region.name}' lies outside of the scan", scan.path, "a scan that shows it", "outside_image")
    mask = np.zeros(shape, np.bool_)
    mask[tuple(at.T)] = True
    return mask


def finest_mm(scan: CtSeries) -> float:
    """Distance of a region's points, mm, at which no voxel between two of them is missed."""
    plane = scan.stack.plane
    return 0.4 * min(*plane.spacing_mm, float(np.linalg.norm(scan.stack.step_ct)))


def rod_points(ends_ct: Floats, radius_mm: float, step_mm: float) -> Floats:
    """Points of a rod about the line through ``ends_ct`` (m, 3), shape (n, 3), mm, ``step_mm`` apart."""
    pieces = []
    for start, end in itertools.pairwise(ends_ct):
        length = float(np.linalg.norm(end - start))
        along = start + np.linspace(0.0, 1.0, max(math.ceil(length / step_mm), 1) + 1)[:, None] * (end - start)
        side = np.linalg.svd((end - start)[None])[2][1:]  # two unit vectors across the axis
        grid = np.linspace(-radius_mm, radius_mm, 2 * math.ceil(radius_mm / step_mm) + 1)
        a, b = (one.ravel() for one in np.meshgrid(grid, grid))
        across = np.stack([a, b], axis=1)[np.hypot(a, b) <= radius_mm] @ side
        pieces.append((along[:, None] + across).reshape(-1, 3))
    return np.concatenate(pieces)


def surface_points(points_ct: Floats, faces: Ints, step_mm: float) -> Floats:
    """Points of triangles, shape (n, 3): their corners, divided until no edge is longer than a step."""
    from trimesh.remesh import subdivide_to_size

    divided, _ = subdivide_to_size(points_ct, faces, step_mm, max_iter=20)
    return np.asarray(divided)


def _series(title: str, number: int) -> dict[str, Any]:
    """Identifiers of an object: a new instance in a series of its own, since its date and time are new too."""
    own = version("puncture-twin")
    series = {"series_instance_uid": generate_uid(), "series_number": number, "series_description": title[:64]}
    instance = {"sop_instance_uid": generate_uid(), "instance_number": 1, "manufacturer": MAKER}
    made_by = {"manufacturer_model_name": MAKER, "software_versions": own, "device_serial_number": own}
    return {**series, **instance, **made_by}


def _segmentation(sources: list[Dataset], scan: CtSeries, content: ArchiveContent, masks: Sequence[Bools]) -> Dataset:
    hd = _highdicom()
    described = [
        hd.seg.SegmentDescription(
            segment_number=number,
            segment_label=region.name,
            segmented_property_category=KINDS[region.kind][0],
            segmented_property_type=KINDS[region.kind][1],
            algorithm_type="AUTOMATIC",
            algorithm_identification=hd.AlgorithmIdentificationSequence(
                name=MAKER, family=Code("planner", SCHEME, "Needle planner"), version=version("puncture-twin")
            ),
        )
        for number, region in enumerate(content.regions, start=1)
    ]
    stacked = np.stack([mask.transpose(2, 1, 0) for mask in masks], axis=-1).astype(np.uint8)
    if len(sources) == 1:  # the stack need not have every frame of its file in its order
        placed = np.zeros((int(sources[0].NumberOfFrames), *stacked.shape[1:]), stacked.dtype)
        placed[[one.frame for one in scan.stack.slices]] = stacked
        stacked = placed
    return hd.seg.Segmentation(
        source_images=sources,
        pixel_array=stacked,
        segmentation_type="BINARY",
        segment_descriptions=described,
        content_label="PUNCTURE",
        **_series(content.title, 9001),
    )


def _report(sources: list[Dataset], scan: CtSeries, content: ArchiveContent) -> Dataset:
    hd = _highdicom()
    root = hd.sr.ContainerContentItem(name=_named(content.title))
    within = {"relationship_type": "CONTAINS"}
    items: list[Dataset] = [hd.sr.TextContentItem(_named(head), said, **within) for head, said in content.sentences]
    for name, points in content.lines.items():
        kind, where = "POINT" if len(points) == 1 else "POLYLINE", np.asarray(points, np.float64)
        items.append(hd.sr.Scoord3DContentItem(_named(name), kind, where, scan.frame_of_reference, **within))
    for one in content.quantities:
        unit = Code(UNITS[one.unit], "UCUM", one.unit or "no units")
        items.append(hd.sr.NumContentItem(_named(one.name), one.value, unit, **within))
    root.ContentSequence = hd.sr.ContentSequence(items)
    return hd.sr.Comprehensive3DSR(
        evidence=sources,
        content=root,
        is_complete=True,
        specific_character_set="ISO_IR 192",
        **_series(content.title, 9002),
    )


def _named(name: str) -> Code:
    """A concept of our own, whose code is its name's hash: codes have 16 characters at most, meanings 64."""
    return Code(hashlib.sha256(name.encode()).hexdigest()[:16], SCHEME, name[:64])


def _bytes(dataset: Dataset) -> bytes:
    stream = io.BytesIO()
    dataset.save_as(stream, enforce_file_format=True)
    return stream.getvalue()


def _check_segments(data: bytes, scan: CtSeries, regions: Sequence[Region], masks: Sequence[Bools]) -> None:
    """Read the segmentation as a case would; the voxels must be those that were drawn."""

    def content(name: str) -> bytes:
        return data if name == SEGMENTS else scan.content(name)

    read = parse_segmentation(Path(SEGMENTS), SEGMENTS, content, scan).masks
    if list(read) != [region.name for region in regions]:
        raise RuntimeError(f"{SEGMENTS} reads back with the segments {list(read)}")
    T_stack_ct = np.linalg.inv(scan.stack.T_ct_index)
    for region, mask in zip(regions, masks, strict=True):
        volume = read[region.name].volume()
        indices = apply(T_stack_ct @ volume.T_ct_index, np.argwhere(volume.values > 0).astype(float))
        if not np.array_equal(np.unique(np.rint(indices).astype(int), axis=0), np.argwhere(mask)):
            raise RuntimeError(f"{SEGMENTS}: '{region.name}' does not read back as it was drawn")


def _check_report(data: bytes, content: ArchiveContent) -> None:
    """Read the report; lines must be equal in single precision, which DICOM has for them, all else exactly."""
    lines = {name: np.asarray(points, np.float32).astype(float).tolist() for name, points in content.lines.items()}
    quantities = {one.name[:64]: (one.value, UNITS[one.unit]) for one in content.quantities}
    sentences = tuple((heading[:64], sentence) for heading, sentence in content.sentences)
    if report_content(data) != ArchiveText(content.title[:64], lines, quantities, sentences):
        raise RuntimeError(f"{REPORT} does not read back as it was written")


class ArchiveText(NamedTuple):
    """A report as it is read: lines in LPS mm, quantities with their UCUM units, sentences with their headings."""

    title: str
    lines: dict[str, list[list[float]]]
    quantities: dict[str, tuple[float, str]]
    sentences: tuple[tuple[str, str], ...]


def report_content(data: bytes) -> ArchiveText:
    """The content of a report that `archive_files` wrote."""
    read = dcmread(io.BytesIO(data))
    lines, quantities, sentences = {}, {}, []
    for item in read.ContentSequence:
        name = str(item.ConceptNameCodeSequence[0].CodeMeaning)
        if item.ValueType == "TEXT":
            sentences.append((name, str(item.TextValue)))
        elif item.ValueType == "SCOORD3D":
            lines[name] = np.reshape(np.asarray(item.GraphicData, float), (-1, 3)).tolist()
        else:
            measured = item.MeasuredValueSequence[0]
            unit = str(measured.MeasurementUnitsCodeSequence[0].CodeValue)
            quantities[name] = (float(measured.FloatingPointValue), unit)
    return ArchiveText(str(read.ConceptNameCodeSequence[0].CodeMeaning), lines, quantities, tuple(sentences))


def _highdicom() -> Any:
    """The library that writes SEG and SR; it is an extra, and takes a second to load."""
    require_extra("dicom", f"--format {DICOM}")
    import highdicom

    return highdicom
