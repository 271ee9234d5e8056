"""``manifest.json``: what an output folder holds, an entry for each command, and the checks of whoever reads it.

A file belongs to the folder's set only if the manifest lists it with the hash of its bytes.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any, NamedTuple

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import is_plain_file, read_input
from puncture_twin.planning.base.provenance import Input, inputs_document, read_inputs
from puncture_twin.planning.base.strict_json import field, fitting, read_json, text, texts

MANIFEST_NAME = "manifest.json"
TIMINGS_NAME = "timings.json"
"""Wall times and dates of the runs: the one file of a set whose bytes differ from run to run, listed without a hash."""
FORMAT = "puncture-twin output set"
"""Marks this program's manifest among others named ``manifest.json``."""
LAYOUT = 1
"""Version of the manifest's layout."""
MAX_MANIFEST_BYTES = 50_000_000
"""A line for each of a hundred thousand files; a larger one is something else."""
LONGEST_NAME = 1000
"""Bytes of a file's name with its sub-folders; we write some forty."""
LONGEST_PART = 255
"""Bytes of one part of it, which is what file systems take."""
ANOTHER_FOLDER = "another output folder, or remove that file"


@dataclass(frozen=True)
class ManifestEntry:
    """The files that one command wrote, with their hashes, its inputs and what it depends on."""

    version: str
    inputs: tuple[Input, ...]
    depends_on: tuple[str, ...]  # entries of the same folder without which this one means nothing
    files: Mapping[str, str]  # file name, relative to the folder with ``/``, to SHA-256

    def document(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "version": self.version,
            "inputs": inputs_document(self.inputs),
            "depends_on": list(self.depends_on),
            "files": dict(self.files),
        }


@dataclass(frozen=True)
class Manifest:
    """The entries of a folder, and the names that an unfinished run may have left there."""

    entries: Mapping[str, ManifestEntry]  # name of the command to what it wrote
    unfinished: tuple[str, ...] = ()  # files that belong to no entry any more, or not yet; the next run removes them

    @property
    def files(self) -> dict[str, str]:
        """Every listed file and its SHA-256."""
        return {name: digest for entry in self.entries.values() for name, digest in entry.files.items()}

    def owner(self, name: str) -> str | None:
        """The entry that lists a file, or None."""
        return next((key for key, entry in self.entries.items() if name in entry.files), None)

    def text(self) -> str:
        """The manifest as it is written: the same entries give the same bytes."""
        document = {
            "format": FORMAT,
            "layout": LAYOUT,
            "entries": {name: entry.document() for name, entry in self.entries.items()},
            "unfinished": list(self.unfinished),
            "not_hashed": [TIMINGS_NAME],
        }
        return json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n"


def is_output_folder(folder: Path) -> bool:
    """Whether this program wrote a folder: the manifest in it says so."""
    path = folder / MANIFEST_NAME
    if not is_plain_file(path):
        return False
    try:
        return FORMAT.encode() in read_input(path, max_bytes=MAX_MANIFEST_BYTES, where=str(path))
    except InputError:
        return False


class Output(NamedTuple):
    """A file that some command wrote, read once."""

    path: Path
    data: bytes
    sha256: str
    note: str  # a warning where the file lies outside of any set, else empty

    def input(self, role: str) -> Input:
        """This file as an input, for the provenance of what is made from it."""
        return Input(role, self.path.name, self.sha256)


def read_output(path: Path, *, max_bytes: int) -> Output:
    """Read what an earlier command wrote, and refuse it where its folder's manifest tells otherwise."""
    data = read_input(path, max_bytes=max_bytes, where=str(path))
    digest = hashlib.sha256(data).hexdigest()
    home = path.resolve()
    if home.name == MANIFEST_NAME:
        refuse("is not one of the files that it lists", path, "a file that it lists", "not_in_manifest")
    manifest = _set_of(home.parent)
    if manifest is None:
        return Output(path, data, digest, f"{path} is not part of an output set, so its completeness cannot be checked")
    if manifest.files.get(home.name) != digest:
        wrong = "has no entry" if home.name not in manifest.files else "does not match its entry"
        what = f"{wrong} in {MANIFEST_NAME} next to it: the output is incomplete, or the file was edited"
        refuse(what, path, "the unchanged output of a finished run: run the command again", "output_not_whole")
    return Output(path, data, digest, "")


def problems(folder: Path) -> tuple[str, ...]:
    """Why a folder is not one whole set, in sentences. Raises InputError: see `read_manifest`."""
    manifest = read_manifest(folder)
    if manifest is None:
        return (f"{MANIFEST_NAME} is missing",)
    faults = [f"{name} is left over from an unfinished run" for name in manifest.unfinished if (folder / name).exists()]
    for name, digest in manifest.files.items():
        path = folder / name
        if not path.is_file():
            faults.append(f"{name} is missing")
        elif file_digest(path) != digest:
            faults.append(f"{name} does not match its entry")
    return tuple(faults)


def read_manifest(folder: Path) -> Manifest | None:
    """A folder's manifest; None where there is none. Raises InputError: it is damaged, or another program's."""
    path = folder / MANIFEST_NAME
    if not path.exists():
        return None
    document = _document(path)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        refuse("is not the manifest of an output folder", path, ANOTHER_FOLDER, "not_an_output_folder")
    with fitting(path, ANOTHER_FOLDER):
        if document["layout"] != LAYOUT:
            raise ValueError(f"layout {document['layout']}")
        entries = {name: _entry(entry) for name, entry in document["entries"].items()}
        unfinished = tuple(map(_name, document["unfinished"]))
        listed = Counter([*unfinished, *(name for entry in entries.values() for name in entry.files)])
        if twice := {name for name, count in listed.items() if count > 1}:
            raise ValueError(f"{min(twice)!r} is listed twice")
        return Manifest(MappingProxyType(entries), unfinished)


def file_digest(path: Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _set_of(folder: Path) -> Manifest | None:
    """The manifest of the set in a folder; None where there is none, or another program's."""
    path = folder / MANIFEST_NAME
    if path.exists():
        document = _document(path)
        if isinstance(document, dict) and document.get("format") == FORMAT:
            return read_manifest(folder)
    return None


def _document(path: Path) -> Any:
    return read_json(path, max_bytes=MAX_MANIFEST_BYTES, allowed=ANOTHER_FOLDER)


def _entry(document: dict[str, Any]) -> ManifestEntry:
    files = {_name(name): text(digest) for name, digest in document["files"].items()}
    version, depends_on = field(document, "version", text), field(document, "depends_on", texts)
    return ManifestEntry(version, read_inputs(document["inputs"]), depends_on, MappingProxyType(files))


def _name(name: Any) -> str:
    """A file's name that stays within the folder and that a file can have: what is listed is removed one day."""
    parts = PurePosixPath(name).parts
    if not parts or set("\\\0") & set(name) or name != "/".join(parts) or {"..", "/", "."} & set(parts):
        raise ValueError(f"the name {name[:LONGEST_PART]!r}")
    if len(name.encode()) > LONGEST_NAME or max(len(part.encode()) for part in parts) > LONGEST_PART:
        raise ValueError(f"the name {name[:LONGEST_PART]!r}, which cannot be a file name")
    return str(name)
