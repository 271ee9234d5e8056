"""A folder of masks: one volume a structure, named after its file, as TotalSegmentator writes them by default."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.files import is_folder
from puncture_twin.planning.formats.labels.labelmaps import LabelMap
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid, corner_deviation_mm

MASK_ENDINGS = (".nii.gz", ".nii", ".seg.nrrd", ".nrrd")
"""Endings of files that are masks; other files of the folder (statistics, previews) are passed over."""
UNREAD_VOLUMES = (".mha", ".mhd", ".hdr", ".img", ".mgz", ".mgh", ".mnc", ".nii.bz2")
"""Endings of volumes that other programs write and this one does not read: a structure in one would count as free."""
UNREAD = "is a volume of a kind that is not read (convert it to NIfTI or NRRD)"
MAX_MASKS = 1000
"""TotalSegmentator has 117 classes."""
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


def mask_files(folder: Path, *, where: str | Path) -> tuple[str, ...]:
    """The names of the masks in a folder, sorted.

    Args:
        folder: Where they are.
        where: The file and key that name the folder, for errors.

    Raises:
        InputError: No folder, no mask in it, too many, two of one structure, or a volume that would be passed over.
    """
    allowed = f"a folder of 1 to {MAX_MASKS} masks ({', '.join(MASK_ENDINGS)}), one a structure"
    if not is_folder(folder):
        raise InputError(f"'{folder.name[:200]}' is no folder", where=where, allowed=allowed)
    _refuse_unread(folder, allowed)
    files = sorted(one.name for one in folder.iterdir() if one.name.lower().endswith(MASK_ENDINGS) and one.is_file())
    if not 1 <= len(files) <= MAX_MASKS:
        raise InputError(f"'{folder.name}' holds {len(files)} masks", where=where, allowed=allowed)
    names: dict[str, str] = {}
    for file in files:
        if (other := names.setdefault(structure_name(file), file)) is not file:
            raise InputError(f"'{other}' and '{file}' are masks of one name", where=where, allowed=allowed)
    return tuple(files)


def _refuse_unread(folder: Path, allowed: str) -> None:
    """A mask in another format, or a header with its voxels beside it, would be passed over and its organ lost."""
    for one in sorted(folder.iterdir()):
        if one.name.lower().endswith((*UNREAD_VOLUMES, ".nhdr")) and one.is_file():
            raise InputError(UNREAD, where=one, allowed=allowed)


def mask_label(mask: LabelMap) -> int | None:
    """The one value beside 0 that a mask's voxels have, often 1 or 255; None for an empty mask.

    Raises:
        InputError: Several values: a label map, not the mask of one structure.
    """
    present = mask.labels_present()
    if len(present) > 1:
        shown = ", ".join(map(str, present[:8]))
        raise InputError(
            f"is no mask: its voxels have the labels {shown}{', ...' if len(present) > 8 else ''}",
            where=mask.path,
            allowed="0 and one other value; a label map is named with labelmap, outside of a folder of masks",
        )
    return present[0] if present else None


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
