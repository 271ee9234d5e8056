"""A folder of which every entry is accounted for: read, known to be harmless, or named with the reason why not.

An organ may lie in a format that nobody reads, behind a link to a file that is not there, in a download that did not
end or in a folder of its own. A reader that looks for what it knows passes it over, and it counts as free.
"""

import os
import re
from collections.abc import Callable, Collection
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import absence
from puncture_twin.planning.base.output.manifest import is_output_folder

FILE, FOLDER, HIDDEN = "", "is a folder", "is hidden"
"""Kinds of most entries; of all others it is stated why they are neither."""
NOT_READ = "of an unsupported kind"
HARMLESS = (
    *(".ds_store", "thumbs.db", "desktop.ini", ".directory", ".git*", ".datalad", ".dvc", ".dvcignore"),
    *(".nfs*", ".~lock.*", ".ipynb_checkpoints"),
    *("manifest.json", "statistics.json", "statistics_radiomics.json", "dataset.json", "plans.json"),
    *("predict_from_raw_data_args.json", "postprocessing.pkl"),
    *("readme", "readme.*", "license", "license.*", "*.txt", "*.md", "*.log", "*.html", "*.pdf"),
    *("*.jpg", "*.jpeg", "*.png", "*.bmp", "*.mtl", "*.yaml", "*.yml", "*.py", "*.sh", "*.ipynb", "*.cff"),
    *("*.toml", "*.csv", "*.tsv", "*.fcsv", "*.mrk.json", "*.mrml", "*.itksnap", "*.label", "*.ctbl"),
    *("*sums", "*.sha256", "*.md5"),
)
"""Names of what can hold no organ, in lower case: of file managers, of versions, what segmentation programs write
with their masks, cases, scenes, tables, lists of points, pictures and plain text."""
STRUCTURE_LIKE = re.compile(
    r"\.(nii|nrrd|nhdr|mha|mhd|hdr|img|mgz|mgh|mnc|npz|npy|dcm|stl|obj|ply|glb|gltf|vtp|vtk|vtu|3mf|wrl)(?![a-z0-9])",
    re.I,
)
"""Names of what may be a structure: of volumes and meshes, also those that are not read, packed, cut or renamed."""
ABOUT_MASK = (".dvc", ".json")
"""Endings of files about a file next to them, whose name they have with or without its own ending."""
PROBABILITIES, VOLUMES = (".npz", ".pkl"), (".nii.gz", ".nii", ".nrrd")
"""Endings of what nnU-Net writes about each mask, and of the mask next to it."""
THUMBNAILS = "@eaDir"
"""The folder in which a file server keeps previews, each named like the file that it shows."""
APPLE_DOUBLE = "._"
"""Beginning of the name of a file in which macOS keeps what another file system cannot, next to the file itself."""
MOST_DEPTH, MOST_INSIDE = 6, 100_000
"""Folders in folders, and entries of each, that are looked through for something that is not accounted for."""


class Entry(NamedTuple):
    """One entry of a folder."""

    name: str
    what: str  # `FILE`, `FOLDER`, `HIDDEN` (either, by its name), or why it is neither

    @property
    def line(self) -> str:
        """Name of the entry, and why it is not read."""
        return f"{self.name} ({self.what or NOT_READ})"


def entries(folder: Path, *, most: int, allowed: str = "a readable folder") -> tuple[Entry, ...]:
    """Entries of a folder, by name: also hidden files and dead links. Raises InputError: unreadable, or too many."""
    try:
        with os.scandir(folder) as listed:
            found = sorted(Entry(one.name, _what(one)) for one in listed)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"cannot be read ({why})", where=folder, allowed=allowed, code="folder_not_listed") from error
    if len(found) > most:
        refuse(f"has {len(found)} files, more than {most}", folder, allowed, "folder_too_large")
    return tuple(found)


def _what(one: os.DirEntry[str]) -> str:
    try:
        if one.name.startswith(".") and (one.is_file() or one.is_dir()):
            return HIDDEN
        return FILE if one.is_file() else absence(Path(one.path))
    except OSError:  # a link that leads to itself, or through a folder that may not be entered
        return absence(Path(one.path))


def unaccounted(folder: Path, listed: tuple[Entry, ...], known: Callable[[Path], bool], depth: int = 0) -> list[Entry]:
    """The entries of a folder that are neither known (read, by whoever asks or someone else) nor harmless.

    A folder in it is accounted for if it is passed over, or if all that it holds is accounted for.
    """
    names = {one.name for one in listed}
    return [
        one
        for one in listed
        if not known(folder / one.name)
        and not (one.what in (FILE, HIDDEN) and is_harmless(one.name, names))
        and not (one.what == FOLDER and _contains_known(folder / one.name, known, depth + 1))
    ]


def is_harmless(name: str, names: Collection[str]) -> bool:
    """Whether a name is that of something that holds no organ, among the names of its folder.

    A volume's or mesh's name with something behind it is so only beside that volume or mesh itself.
    """
    stem, _, _ = name.rpartition(".")
    if name.endswith(PROBABILITIES) and any(stem + end in names for end in VOLUMES):
        return True
    about = next((name.removesuffix(end) for end in ABOUT_MASK if name.endswith(end)), name)
    about = about.removeprefix(APPLE_DOUBLE)
    if about != name and any(f"{one}.".startswith(f"{about}.") and not one.endswith(ABOUT_MASK) for one in names):
        return True
    inferred = not STRUCTURE_LIKE.search(name) or stem in names
    return inferred and any(fnmatchcase(name.lower(), pattern) for pattern in HARMLESS)


def is_passed_over(folder: Path) -> bool:
    """Whether a folder contains nothing of a patient: this program's output, previews or versions."""
    versions = folder.name.startswith(".") and is_harmless(folder.name, ())
    return versions or folder.name == THUMBNAILS or is_output_folder(folder)


def _contains_known(folder: Path, known: Callable[[Path], bool], depth: int) -> bool:
    if is_passed_over(folder):
        return True
    if depth > MOST_DEPTH or STRUCTURE_LIKE.search(folder.name):
        return False
    return not unaccounted(folder, entries(folder, most=MOST_INSIDE), known, depth)


def structure_below(folder: Path) -> str:
    """Path of something named like a volume or mesh below a folder; "" if there is none and all was seen."""
    seen, closed = 0, list[OSError]()
    for top, folders, files in os.walk(folder, onerror=closed.append, followlinks=True):
        folders[:] = [one for one in folders if not is_passed_over(Path(top, one))]
        seen += len(folders) + len(files)
        if named := [one for one in (*folders, *files) if STRUCTURE_LIKE.search(one)]:
            return str(Path(top, min(named)).relative_to(folder))
        if closed or seen > MOST_INSIDE:
            return "an unreadable folder" if closed else f"more than {MOST_INSIDE} files"
    return "an unreadable folder" if closed else ""
