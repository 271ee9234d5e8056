"""Folders of masks, one volume a structure, named after its file; and segments of Slicer (.seg.nrrd), as masks.

Source: Slicer documentation, "Segmentations", file format: ``SegmentN_Name``, ``SegmentN_LabelValue`` and, where the
file has several layers, ``SegmentN_Layer``, counted from 0.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import is_folder
from puncture_twin.planning.base.text import first_few
from puncture_twin.planning.formats.dicom.named_masks import Mask, MaskVolume, NamedMasks
from puncture_twin.planning.formats.folder import FILE, Entry, entries, unaccounted
from puncture_twin.planning.formats.labels.labelmaps import LabelMap, Segment, listed_segments
from puncture_twin.planning.formats.meshes.mesh_files import MESH_SUFFIXES
from puncture_twin.planning.formats.volumes.nrrd_header import parse_layered_header
from puncture_twin.planning.formats.volumes.volume_files import Content
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid, VolumeHeader, corner_deviation_mm, decoded

MASK_ENDINGS = (".nii.gz", ".nii", ".seg.nrrd", ".nrrd")
"""Endings of files that are masks."""
READ = ", ".join((*MASK_ENDINGS, *MESH_SUFFIXES, "DICOM"))
"""Kinds of files from which structures are read."""
MAX_MASKS, MAX_ENTRIES = 1000, 60_000
"""TotalSegmentator has 117 classes; the slices of a CT may lie next to them."""
SAME_PLACE_MM = 0.1
"""Two grids whose corners lie this close are one: headers in single precision round to 0.01 mm."""


def structure_name(file: str) -> str:
    """The name of the structure in a file: the file's own, without its ending.

    >>> structure_name("segmentations/rib_left_7.nii.gz")
    'rib_left_7'
    """
    name = file.rpartition("/")[2]
    ending = next((one for one in MASK_ENDINGS if name.lower().endswith(one)), "")
    return name[: len(name) - len(ending)]


def mask_files(folder: Path, known: Callable[[Path], bool], *, where: str | Path) -> tuple[str, ...]:
    """The names of the masks in a folder, sorted; nothing else may lie in it that could be an organ.

    ``known``: whether a path in it is something else that the case names. Raises InputError: no folder, none, too many,
    two of one structure, or entries that would be passed over.
    """
    allowed = f"a folder of 1 to {MAX_MASKS} masks ({', '.join(MASK_ENDINGS)}), one per structure"
    if not is_folder(folder):
        refuse(f"'{folder.name[:200]}' is not a folder", where, allowed, "not_a_folder")
    listed = entries(folder, most=MAX_ENTRIES, allowed=allowed)
    masks = [one.name for one in listed if one.what == FILE and one.name.lower().endswith(MASK_ENDINGS)]
    files = [name for name in masks if not known(folder / name)]
    left = unaccounted(folder, listed, lambda path: path.name in files or known(path))
    if left:
        raise not_read(left, "masks", where)
    if not 1 <= len(files) <= MAX_MASKS:
        refuse(f"'{folder.name}' has {len(files)} masks", where, allowed, "wrong_count")
    refuse_same_name(files, where)
    return tuple(files)


def refuse_same_name(files: Sequence[str], where: str | Path) -> None:
    """Refuse two masks of a folder that are of one structure, such as ``liver.nii`` next to ``liver.nii.gz``."""
    names: dict[str, str] = {}
    for file in files:
        if (other := names.setdefault(structure_name(file), file)) is not file:
            allowed = "one mask per structure: move one of the two out of the folder"
            refuse(f"'{other}' and '{file}' are masks with the same name", where, allowed, "masks_of_one_name")


def not_read(left: Sequence[Entry], among: str, where: str | Path) -> InputError:
    """Entries of a folder of masks or meshes that are not read: their organs would count as free."""
    return InputError(
        f"the folder also has files that cannot be read and may be organs: {first_few([one.line for one in left])}",
        where=where,
        allowed=f"{among} ({READ}), and nothing else: convert, download or move the other files",
        code="entries_not_read",
    )


def refuse_label_map(mask: LabelMap) -> None:
    """Refuse a mask whose voxels have several values besides 0: a label map. One, often 1 or 255, or none is right."""
    present = mask.labels_present()
    if len(present) > 1:
        what = f"is not a mask: its voxels have the labels {first_few(list(map(str, present)))}"
        allowed = "0 and one other value; give a label map with labelmap, outside the folder of masks"
        refuse(what, mask.path, allowed, "not_a_mask")


def on_one_grid(one: VolumeGrid, other: VolumeGrid) -> bool:
    """Whether two volumes have the same voxels in the same place."""
    same_place = corner_deviation_mm(one.T_ct_index, other.T_ct_index, one.shape) <= SAME_PLACE_MM
    return one.shape == other.shape and same_place


def check_one_grid(headers: Mapping[str, VolumeGrid], *, where: str | Path) -> None:
    """Refuse masks of a folder on two grids: what lies beyond the smaller one would count as free."""
    (first, grid), *others = headers.items()
    for name, other in others:
        if other.shape != grid.shape:
            own, size = (" x ".join(map(str, one.shape)) for one in (other, grid))
            difference = f"{own} voxels, not {size}"
        elif (apart := corner_deviation_mm(grid.T_ct_index, other.T_ct_index, grid.shape)) > SAME_PLACE_MM:
            difference = f"up to {apart:.1f} mm away"
        else:
            continue
        allowed = "masks of one CT, all on one grid; other masks as [[structure]] with labelmap and label"
        refuse(f"mask {name} has another grid than {first}: {difference}", where, allowed, "other_grid")


SEGMENT_ENDING = ".nrrd"
"""Ending of segmentations that Slicer saves, in lower case: their header and voxels are one file."""


def parse_segments(path: Path, file: str, content: Content) -> NamedMasks:
    """The segments of a Slicer segmentation by name. Raises InputError: none, or two of one name or label."""
    header = parse_layered_header(content(file), path)
    if header.data_path != path:
        refuse(f"its voxels are in {header.data_path.name}", path, "header and voxels in one file", "data_elsewhere")
    if header.cells.dtype.kind not in "iu":
        refuse(f"voxels of type {header.cells.dtype}", path, "whole numbers", "wrong_type")
    segments = listed_segments(header.fields, header.layers, path)
    listed = frozenset(segments.values())
    masks = {
        name: MaskVolume(path, (file,), (name,), header, partial(_mask, content, file, header, segment, listed))
        for name, segment in segments.items()
    }
    return NamedMasks(masks, header.notes)


def _mask(content: Content, file: str, header: VolumeHeader, segment: Segment, listed: frozenset[Segment]) -> Mask:
    voxels = decoded(memoryview(content(file)), header)
    layer = voxels[segment.layer] if header.layers > 1 else voxels
    lost = layer[~np.isin(layer, [0, *(one.label for one in listed if one.layer == segment.layer)])]
    if lost.size:
        what = f"layer {segment.layer} has voxels of {np.unique(lost)[:8].tolist()}, which belong to no segment"
        refuse(what, header.data_path, "a segment for each label", "label_without_segment")
    return np.asarray(layer == segment.label).astype(np.uint8)
