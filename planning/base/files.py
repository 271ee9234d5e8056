"""Files: content hashes, writing that leaves the whole file or nothing, and the bytes of an input file."""

import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from puncture_twin.planning.base.errors import InputError, refuse, refusing

OUTPUT_NAMES = (
    *("manifest.json", "timings.json", "candidates.parquet", "certificate.json", "map.png", "scene.png", "slices.png"),
    *("report.html", "plan.json", "rehearsal.json", "rehearsal.mp4", "batch.csv", "placements.csv", "place.json"),
    *("placements.png", "map_best_place.png", "calibration.json", "recording.csv", "bmode.png", "room.png"),
    *("servo.html", "convergence.png", "camera_1.png", "camera_2.png"),
)
"""The files that commands write into their output folder."""


def sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes. Raises InputError: the file cannot be read."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        what = f"cannot be read ({error.strerror})"
        raise InputError(what, where=path, allowed="a readable file", code="unreadable") from error


def is_plain_file(path: Path) -> bool:
    """Whether a file is there; also of a name too long, or with a NUL in it, for which the system raises."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Whether a folder is there, whatever its name."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path``, moved there if the block ends well. Raises InputError: nothing can be made."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    except OSError as error:
        what = f"cannot be written ({error.strerror})"
        where = _shown(path)
        raise InputError(what, where=where, allowed="a writable folder", code="unwritable") from error
    os.close(handle)
    temporary = Path(name)
    temporary.chmod(0o644)
    try:
        yield temporary
        if path.is_dir():
            refuse("is a folder", _shown(path), "the name of a file", "unwritable")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(folder: Path | str) -> Path:
    """Refuse a folder into which nothing can be written, or of no usable name, before any work; nothing is created."""
    allowed = "a writable folder, or a new name"
    if not isinstance(folder, str | Path):
        refuse(f"a {type(folder).__name__} is no path", "output folder", allowed, "wrong_type")
    folder = Path(folder)
    with refusing((OSError, ValueError), "output folder cannot be used", _shown(folder), allowed, "unwritable"):
        if b"\0" in str(folder).encode("utf-8"):
            raise ValueError("embedded null byte")
        nearest = next(place for place in (folder, *folder.absolute().parents) if place.exists() or place.is_symlink())
        usable = nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)
        if usable:  # and if every part of the name fits the file system, and no folder of a file's name is in the way
            longest = os.pathconf(nearest, "PC_NAME_MAX")
            usable = all(len(part.encode()) <= longest for part in folder.parts)
            usable = usable and not any((folder / name).is_dir() for name in OUTPUT_NAMES)
    if not usable:
        refuse("output folder cannot be written to", _shown(folder), allowed, "unwritable")
    return folder


@contextmanager
def new_folder(path: Path | None) -> Iterator[Path | None]:
    """A folder that appears whole or not at all; None for none. Raises InputError: something is there or in the way."""
    if path is None:
        yield None
        return
    if path.exists():
        refuse("is there already", path, "a new folder", "output_exists")
    with tempfile.TemporaryDirectory(dir=check_writable(path.parent), prefix=".") as parent:
        draft = Path(parent) / path.name
        draft.mkdir()
        yield draft
        draft.replace(path)


def _shown(path: Path) -> str:
    return str(path).encode("utf-8", "replace").decode("utf-8")[:200]


def read_input(path: Path, *, max_bytes: int, where: str, allowed: str = "") -> bytes:
    """All bytes of a file. Raises InputError: it is missing, no regular file, empty, too large, or not readable."""
    allowed = allowed or f"a readable file of 1 to {max_bytes} bytes"
    with refusing((OSError, ValueError), "cannot be read", where, allowed, "unreadable"):  # or a path with a NUL in it
        if not path.exists():
            other = _other_case(path)
            what = f"no such file; did you mean '{other}'?" if other else "no such file"
            refuse(what, where, allowed, "no_such_file")
        if not path.is_file():
            refuse("is a directory or device, not a file", where, allowed, "not_a_file")
        size = path.stat().st_size
        if not 0 < size <= max_bytes:
            refuse(f"has {size} bytes", where, allowed, "file_size")
        return path.read_bytes()


def absence(path: Path) -> str:
    """Why there is no plain file at a path, as it is: "is a folder", or "is not there", and what is there instead."""
    try:
        if path.is_dir():
            return "is a folder"
        if path.exists():
            return "is not a regular file"
        if path.is_symlink():
            return "is a link to a missing file"
        other = _other_case(path)
    except PermissionError as error:
        return f"cannot be looked up ({error.strerror})"
    except (OSError, ValueError):  # a name that no file system takes
        return "does not exist"
    return f"does not exist; did you mean '{other}'?" if other else "does not exist"


def _other_case(path: Path) -> str:
    """A name in the same folder that differs in upper and lower case alone; "" without one."""
    if not path.parent.is_dir():
        return ""
    names = sorted(one.name for one in path.parent.iterdir() if one.name.lower() == path.name.lower())
    return names[0] if names and names[0].isprintable() else ""


def unfinished_warnings(content: bytes, name: str) -> tuple[str, ...]:
    """Warnings about a list whose last line does not end with a line break; spaces after it are no line."""
    if content.rstrip(b" \t").endswith((b"\n", b"\r")):
        return ()
    return (f"{name}: its last line has no line break at its end; was the file cut?",)


def decode_text(data: bytes, where: str) -> str:
    """The text of a file in UTF-8. Raises InputError if it is anything else."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        what = f"byte {error.start} is not text"
        raise InputError(what, where=where, allowed="text in UTF-8", code="not_text") from error
