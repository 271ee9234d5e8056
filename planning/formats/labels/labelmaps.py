"""Label maps: a whole number per voxel that says which structure it belongs to.

A label's voxels become a closed surface in LPS mm by marching cubes on its 0/1 mask at 0.5, padded by background.
Every vertex then lies in the middle between the centres of a voxel inside and one outside, on the face that they share;
and every cell of eight voxel centres that the surface enters holds a piece of the voxels' boundary, through its middle.
So surface and boundary are never more than half a voxel apart along any axis, in both directions. The table of Lorensen
and Cline (1987) decides each cell by signs alone and came out closed for every mask tried; scikit-image's default
(Lewiner 2003) compares products that are all equal in a 0/1 mask, and its ties left holes in random masks.

Tables that say which label is which structure, as programs and people write them: CSV with any common naming of its
columns, JSON (``{"1": "liver"}``, ``{"liver": 1}``, nnU-Net's ``labels``), label descriptions of ITK-SNAP and colour
tables of 3D Slicer.
"""

import csv
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray
from skimage.measure import marching_cubes

from puncture_twin.planning.base.arrays import Bools, Ints
from puncture_twin.planning.base.errors import refuse, refusing
from puncture_twin.planning.base.files import decode_text
from puncture_twin.planning.base.strict_json import parse_json
from puncture_twin.planning.base.text import check_name
from puncture_twin.planning.formats.dicom.named_masks import unique_names
from puncture_twin.planning.formats.guard import guard_mesh
from puncture_twin.planning.formats.volumes.volume_files import Volume, canonical
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.parts import slice_counts
from puncture_twin.planning.geometry.rigid import apply

MAX_LABEL = 65_535
"""Label maps are 8 or 16 bit; a larger value means that an image was given instead."""
ALLOWED = f"whole numbers from 0 (background) to {MAX_LABEL}"
ROUNDED_BY = 0.02
"""How far a value may lie off a whole number: of labels stored in 8 bits with a slope some are off by half a step."""
LEAST_WHOLE = 0.15
"""Fraction of voxels besides the background: a blended map is whole inside its labels, an image in 4 % by chance."""
NEAR_MM, STEADY = 6.0, 0.95
"""How flat a label ends is seen by its outermost slice beside its largest one so near. Near: a cut that takes but the
tip of a round organ leaves an end that is small beside the organ's middle. Not nearer than a coarse map's steps are,
where it was resampled to finer slices. And a block's slices have so much of the largest one there, or more."""
Box = tuple[slice, slice, slice]


class LabelEnds(NamedTuple):
    """Where each of n labels ends along each axis of its file, at the low and the high end."""

    last: NDArray[np.int64]  # shape (n, 3, 2), its first and last slice
    flat_mm: NDArray[np.float64]  # shape (n, 3, 2), how wide and flat each end is: small where it tapers
    block: Bools  # shape (n,), whether it has the same section near both ends along two axes, as what somebody drew

    def only(self, selected: Bools | Ints) -> "LabelEnds":
        """Those of some labels, given by a mask (n,) or by their places."""
        return LabelEnds(self.last[selected], self.flat_mm[selected], self.block[selected])


@dataclass(frozen=True, eq=False)
class LabelMap:
    """Labels in patient space."""

    # shape (ni, nj, nk), of the file's own type where that is whole numbers, read-only; 0 is background
    labels: NDArray[np.integer]
    T_ct_index: NDArray[np.float64]  # shape (4, 4), maps voxel index (i, j, k), at the voxel's centre, to LPS mm
    names: dict[int, str] | None  # label to name, as a .seg.nrrd states it, or None
    path: Path
    rounded_by: float = 0.0  # how far the file's values are off whole numbers, at most

    def __post_init__(self) -> None:
        labels = np.asarray(self.labels).view()
        labels.setflags(write=False)
        object.__setattr__(self, "labels", labels)

    @cached_property
    def boxes(self) -> dict[int, Box]:
        """The smallest index box around each label present."""
        slices = scipy.ndimage.find_objects(self.labels.T)  # as it lies in a file: the first index runs fastest
        return {label: box[::-1] for label, box in enumerate(slices, start=1) if box is not None}

    def labels_present(self) -> tuple[int, ...]:
        """The labels that at least one voxel has, rising, without the background."""
        return tuple(self.boxes)


def label_ends(labelmap: LabelMap) -> LabelEnds:
    """Where the labels present end, and how flat: as what was cut does; organs end round.

    The width of an end is the root of its slice's area; it counts by the cube of that slice's part of the largest near.
    """
    spacing_mm, boxes = np.linalg.norm(labelmap.T_ct_index[:3, :3], axis=0), labelmap.boxes
    last = np.array([[[at.start, at.stop - 1] for at in box] for box in boxes.values()], np.int64).reshape(-1, 3, 2)
    flat_mm, steady = np.zeros(last.shape), np.zeros(last.shape, bool)
    for n, (label, box) in enumerate(boxes.items()):
        for axis, counts in enumerate(slice_counts(labelmap.labels[box] == label)):
            near = 1 + max(1, round(NEAR_MM / spacing_mm[axis]))
            area_mm2, inward = np.prod(np.delete(spacing_mm, axis)), (counts[:near], counts[::-1][:near])
            flat_mm[n, axis] = [np.sqrt(one[0] * area_mm2) * (one[0] / one.max()) ** 3 for one in inward]
            steady[n, axis] = [one.min() >= STEADY * one.max() for one in inward]
    return LabelEnds(last, flat_mm, np.count_nonzero(steady.all(axis=2), axis=1) >= 2)


def labelmap_of(volume: Volume, *, may_be_empty: bool = False) -> LabelMap:
    """The label map that a volume is, in LPS mm; one with background only may be the mask of an organ not there.

    Raises InputError: no labels (`whole_labels`), background only, or segment names that contradict each other.
    """
    names = segment_names(volume.fields, volume.path)
    labels, rounded_by = whole_labels(volume.values, volume.path)
    if not may_be_empty and not labels.any():
        refuse("the label map is empty: every voxel is 0", volume.path, ALLOWED, "empty")
    return LabelMap(labels, volume.T_ct_index, names, volume.path, rounded_by)


def whole_labels(values: NDArray[Any], path: Path) -> tuple[NDArray[np.integer], float]:
    """Voxels as whole numbers, and how far they were off, at most: `ROUNDED_BY`.

    Raises InputError: negative, too large, or farther from whole numbers; a blended map has a code of its own.
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


ALLOWED_SEGMENTS = "a .seg.nrrd as Slicer saves it, with names, label values and layers of its segments"


class Segment(NamedTuple):
    """Layer and label of a segment."""

    layer: int  # from 0
    label: int


def segment_names(fields: Mapping[str, str], path: Path) -> dict[int, str] | None:
    """Label to name, as the remarks of a Slicer segmentation state them; None where they name no segment."""
    if not any(re.fullmatch(r"Segment\d+_Name", key) for key in fields):
        return None
    return {segment.label: name for name, segment in listed_segments(fields, 1, path).items()}


def listed_segments(remarks: Mapping[str, str], layers: int, path: Path) -> dict[str, Segment]:
    """Name to layer and label, of every segment that the header's ``key:=value`` lines list.

    ``layers`` are in the file; the layer of a segment may be left out where it is one.
    """
    numbers = sorted({int(at[1]) for key in remarks if (at := re.match(r"Segment(\d{1,6})_", key))})
    names = [check_name(remarks.get(f"Segment{n}_Name", ""), f"segment {n}", where=path) for n in numbers]
    unique_names(names, path)
    segments = [_segment(remarks, number, layers, path) for number in numbers]
    for name, segment in zip(names, segments, strict=True):
        if segments.count(segment) > 1:
            what = f"segment {name!r} shares label {segment.label} of layer {segment.layer}"
            refuse(what, path, "a label of its own in its layer for each segment", "duplicate_label")
    return dict(zip(names, segments, strict=True))


def _segment(remarks: Mapping[str, str], number: int, layers: int, path: Path) -> Segment:
    fields = []
    for key in (f"Segment{number}_LabelValue", f"Segment{number}_Layer"):
        text = remarks.get(key, "0" if layers == 1 and key.endswith("Layer") else None)
        if text is None or not (text.isascii() and text.isdigit() and len(text) < 10):
            refuse(f"{key} is {'missing' if text is None else repr(text[:20])}", path, ALLOWED_SEGMENTS, "bad_value")
        fields.append(int(text))
    label, layer = fields
    if not (1 <= label <= MAX_LABEL and layer < layers):
        allowed = f"labels from 1 to {MAX_LABEL}, layers from 0 to {layers - 1}"
        refuse(f"segment {number} has label {label} in layer {layer}", path, allowed, "out_of_range")
    return Segment(layer, label)


def label_mesh(labelmap: LabelMap, label: int, *, where: str | Path) -> TriangleMesh:
    """The surface of one label, closed, normals outward, in LPS mm. Raises InputError: if no voxel has this label.

    At the border of the volume it is closed on the outer face of the border voxels. The result does not depend on the
    axis order or the flips in which the map is stored.
    """
    box = labelmap.boxes.get(label)
    if box is None:
        named = labelmap.names or {}
        shown = ", ".join(f"{n} {named[n]}" if n in named else str(n) for n in labelmap.labels_present())
        refuse(f"no voxel has label {label}", where, f"the labels present: {shown}", "label_absent")
    mask = labelmap.labels[box] == label
    T_ct_box = labelmap.T_ct_index.copy()
    T_ct_box[:3, 3] += labelmap.T_ct_index[:3, :3] @ [axis.start for axis in box]
    oriented = canonical(mask, T_ct_box)
    return mask_surface(oriented.values, oriented.T_ct_index, where=where)


def mask_surface(mask: Bools, T_ct_index: NDArray[np.float64], *, where: str | Path) -> TriangleMesh:
    """The closed surface of a mask's voxels, as `framed_surface` of a field that is 1/2 inside and -1/2 outside.

    Of a mask (ni, nj, nk), somewhere True, of which only that box counts; the affine (4, 4) has a positive determinant.
    """
    box = box_in(mask)
    framed, field = frame([axis.stop - axis.start for axis in box])
    np.subtract(mask[box], np.float32(0.5), out=field)
    return framed_surface(framed, T_ct_index, where=where, first=[axis.start for axis in box])


def box_in(mask: Bools, margin: ArrayLike = 0) -> Box:
    """The smallest index box about the True voxels of a mask, and ``margin`` voxels more along each axis."""
    i = np.flatnonzero([plane.any() for plane in mask])
    seen: Bools = np.asarray(mask[i[0] : i[-1] + 1].any(axis=0))
    j, k = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    x, y, z = np.broadcast_to(margin, 3).tolist()
    ends = ((i, x, 0), (j, y, 1), (k, z, 2))
    a, b, c = (slice(max(0, n[0] - m), min(n[-1] + 1 + m, mask.shape[axis])) for n, m, axis in ends)
    return a, b, c


def frame(shape: Sequence[int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """An array for `framed_surface`, not filled, and the view of it within the frame, of a shape (3,)."""
    framed = np.empty([count + 2 for count in shape], np.float32)
    return framed, framed[1:-1, 1:-1, 1:-1]


def framed_surface(
    framed: NDArray[np.float32], T_ct_index: NDArray[np.float64], *, where: str | Path, first: ArrayLike = 0
) -> TriangleMesh:
    """The closed surface around where a field is positive, in LPS mm, normals outward; at the border on outer faces.

    Args:
        framed: Of `frame`: within, the field, never 0, somewhere positive; its frame is written here, the sign flipped.
        T_ct_index: Shape (4, 4), determinant positive.
        first: Shape (3,), index of the field's first voxel, where it is part of a larger one.
    """
    for axis in range(3):
        planes = np.moveaxis(framed, axis, 0)
        planes[0], planes[-1] = -np.abs(planes[1]), -np.abs(planes[-2])
    surface = marching_cubes(framed, level=0.0, method="lorensen", gradient_direction="ascent")
    index, faces = surface[0].astype(np.float64) - 1.0 + first, surface[1]
    return guard_mesh(apply(T_ct_index, index), faces, where=where)


NAME_COLUMNS = (
    "name", "structurename", "labelname", "classname", "organname", "segmentname", "structure", "organ", "segment",
    "class", "anatomy", "description", "text", "label",
)  # fmt: skip
"""Headers of a column of names, the surest first; without spaces and signs."""
NUMBER_COLUMNS = (
    "id", "labelid", "classid", "segmentid", "structureid", "labelvalue", "value", "index", "idx", "number",
    "labelnumber", "label", "class", "key",
)  # fmt: skip
"""Headers of a column of numbers, the surest first."""
BACKGROUND = frozenset({"", "background", "clearlabel", "clear", "none", "unlabelled", "unlabeled", "air"})
"""Names of the background."""
ALLOWED_CSV = "a CSV with a header such as id,name or label,name, and one label per line"
ALLOWED_JSON = 'JSON such as {"1": "liver"}, {"liver": 1} or {"labels": {...}}'
ALLOWED_LIST = 'lines of ITK-SNAP (1 255 0 0 1 1 1 "liver") or of a colour table (1 liver 255 0 0 255)'


class _Entry(NamedTuple):
    number: str
    name: str
    where: str


def parse_names(data: bytes, path: Path) -> dict[int, str]:
    """The names of a table, by label. Raises InputError: no such table, a label that stands twice, or none at all."""
    reader, allowed = _READERS[path.suffix.lower()]
    names: dict[int, str] = {}
    for entry in reader(data, path):
        text = entry.number.strip()
        if not (text.isascii() and text.isdigit() and len(text) < 7 and int(text) <= MAX_LABEL):
            refuse(f"label {text[:40]!r} of {entry.name[:60]!r}", entry.where, allowed, "bad_label")
        label = int(text)
        if label in names:
            refuse(f"id {label} appears twice", entry.where, "each id once", "duplicate_label")
        if label:
            names[label] = entry.name.strip()
        elif _plain(entry.name) not in BACKGROUND:
            refuse(f"label 0 is {entry.name[:60]!r}", entry.where, "0 for the background only", "bad_label")
    if not names:
        refuse("the naming has no label", path, allowed, "empty")
    return names


def _plain(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.lower())


def _csv_entries(data: bytes, path: Path) -> Iterator[_Entry]:
    text = decode_text(data, str(path))
    separator = max((",", ";", "\t"), key=text.lstrip().partition("\n")[0].count)
    with refusing(csv.Error, "is not a CSV file", path, ALLOWED_CSV, "not_csv"):
        reader = csv.reader(io.StringIO(text, newline=""), strict=True, delimiter=separator)
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    header = rows[0][1] if rows else []  # here # is no comment: a colour may begin with it
    plain = [_plain(cell) for cell in header]  # ``label`` is a name next to an id, and a number next to a name
    name = next((plain.index(one) for one in NAME_COLUMNS if one in plain), None)
    number = next((plain.index(one) for one in NUMBER_COLUMNS if one in plain and plain.index(one) != name), None)
    if name is None or number is None:
        shown = ",".join(header)[:100] or "missing"
        refuse(f"header {shown!r} has no column of labels and names", path, ALLOWED_CSV, "wrong_columns")
    for line, row in rows[1:]:
        where = f"{path}, line {line}"
        if len(row) != len(header):
            refuse(f"{len(row)} fields, not {len(header)}: {row}", where, ALLOWED_CSV, "ragged_row")
        yield _Entry(row[number], row[name], where)


def _json_entries(data: bytes, path: Path) -> Iterator[_Entry]:
    tree = parse_json(data, where=path, allowed=ALLOWED_JSON)
    table = tree.get("labels", tree) if isinstance(tree, dict) else None
    if not isinstance(table, dict):
        refuse("not an object of labels", path, ALLOWED_JSON, "wrong_format")
    for key, value in table.items():
        number, name = (key, value) if isinstance(value, str) else (value, key)
        if isinstance(value, list):
            what = f"{str(key)[:60]!r} is a list of labels (a region): list its labels one by one"
            refuse(what, path, ALLOWED_JSON, "labels_of_regions")
        if isinstance(number, bool) or not isinstance(number, str | int) or not isinstance(name, str):
            refuse(f"entry {str(key)[:60]!r} is not a pair of a number and a name", path, ALLOWED_JSON, "wrong_format")
        yield _Entry(str(number), name, str(path))


def _list_entries(data: bytes, path: Path) -> Iterator[_Entry]:
    for line, text in enumerate(decode_text(data, str(path)).splitlines(), start=1):
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        where, closed = f"{path}, line {line}", text.count('"') % 2 == 0  # an apostrophe is no quotation mark
        fields = [one.strip('"') for one in re.findall(r'"[^"]*"|[^\s"]+', text)] if closed else []
        numbers = [re.fullmatch(r"\d+(\.\d*)?|\.\d+", one) is not None for one in fields]
        if not {8: all(numbers[:7]), 6: all(numbers[2:])}.get(len(fields), False):
            refuse(f"{text[:60]!r}", where, ALLOWED_LIST, "unknown_line")
        yield _Entry(fields[0], fields[7] if len(fields) == 8 else fields[1], where)


_Reader = Callable[[bytes, Path], Iterator[_Entry]]
_READERS: Mapping[str, tuple[_Reader, str]] = MappingProxyType(
    {
        ".csv": (_csv_entries, ALLOWED_CSV),
        ".tsv": (_csv_entries, ALLOWED_CSV),
        ".json": (_json_entries, ALLOWED_JSON),
        ".txt": (_list_entries, ALLOWED_LIST),
        ".ctbl": (_list_entries, ALLOWED_LIST),
    }
)
NAME_ENDINGS: tuple[str, ...] = tuple(_READERS)
"""Endings of files that may be such a table."""
