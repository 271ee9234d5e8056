"""A folder of masks: one volume a structure, named after its file, as TotalSegmentator writes them by default."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.files import is_folder
from puncture_twin.planning.base.text import first_few
from puncture_twin.planning.formats.folder import FILE, Entry, entries, unaccounted
from puncture_twin.planning.formats.labels.labelmaps import LabelMap
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid, corner_deviation_mm

MASK_ENDINGS = (".nii.gz", ".nii", ".seg.nrrd", ".nrrd")
"""Endings of files that are masks."""
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

    Args:
        folder: Where they are.
        known: Whether a path in it is something else that the case names.
        where: The file and key that name the folder, for errors.

    Raises:
        InputError: No folder, no mask in it, too many, two of one structure, or entries that would be passed over.
    """
    allowed = f"a folder of 1 to {MAX_MASKS} masks ({', '.join(MASK_ENDINGS)}), one a structure"
    if not is_folder(folder):
        raise InputError(f"'{folder.name[:200]}' is no folder", where=where, allowed=allowed)
    found = entries(folder, most=MAX_ENTRIES, allowed=allowed)
    files = [one.name for one in found if is_mask(one) and not known(folder / one.name)]
    left = unaccounted(folder, found, lambda path: path.name in files or known(path))
    if left:
        raise not_read(left, "masks", where)
    if not 1 <= len(files) <= MAX_MASKS:
        raise InputError(f"'{folder.name}' holds {len(files)} masks", where=where, allowed=allowed)
    refuse_one_name(files, where)
    return tuple(files)


def refuse_one_name(files: Sequence[str], where: str | Path) -> None:
    """Whether each mask of a folder is of another structure: ``liver.nii`` next to ``liver.nii.gz`` is not.

    Raises:
        InputError: Two are of one; names both.
    """
    names: dict[str, str] = {}
    for file in files:
        if (other := names.setdefault(structure_name(file), file)) is not file:
            what = f"'{other}' and '{file}' are masks of one name"
            allowed = "one mask a structure: move one of the two out of the folder"
            raise InputError(what, where=where, allowed=allowed, code="masks_of_one_name")


def is_mask(entry: Entry) -> bool:
    """Whether an entry is read as a mask."""
    return entry.what == FILE and entry.name.lower().endswith(MASK_ENDINGS)


def not_read(left: Sequence[Entry], among: str, where: str | Path) -> InputError:
    """Entries of a folder of masks or meshes that would be passed over: their organs would count as free."""
    return InputError(
        f"beside the {among} lies what is not read, and may be an organ: {first_few([one.line for one in left])}",
        where=where,
        allowed=f"{among} in formats that are read, and nothing else: convert it, fetch it, or move it elsewhere",
        code="entries_not_read",
    )


def refuse_label_map(mask: LabelMap) -> None:
    """Whether a mask's voxels have one value besides 0, often 1 or 255, or none.

    Raises:
        InputError: Several values: a label map, not the mask of one structure.
    """
    present = mask.labels_present()
    if len(present) > 1:
        raise InputError(
            f"is no mask: its voxels have the labels {first_few(list(map(str, present)))}",
            where=mask.path,
            allowed="0 and one other value; a label map is named with labelmap, outside of a folder of masks",
        )


def check_one_grid(headers: Mapping[str, VolumeGrid], *, where: str | Path) -> None:
    """Whether all masks of a folder lie on one grid: what lies beyond a smaller one would count as free.

    Args:
        headers: File name to header.
        where: The folder, for the error.

    Raises:
        InputError: Two differ in shape or place; names both.
    """
    (first, grid), *others = headers.items()
    for name, other in others:
        sizes = [" x ".join(map(str, one.shape)) for one in (grid, other)]
        if other.shape != grid.shape:
            difference = f"{sizes[1]} voxels, not {sizes[0]}"
        elif (apart := corner_deviation_mm(grid.T_ct_index, other.T_ct_index, grid.shape)) > SAME_PLACE_MM:
            difference = f"up to {apart:.1f} mm away"
        else:
            continue
        raise InputError(
            f"mask {name} lies on another grid than {first}: {difference}",
            where=where,
            allowed="masks of one CT, all on one grid; others as [[structure]] with labelmap and label",
        )
