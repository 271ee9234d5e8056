"""Numba with a cache folder of its own for compiled kernels: the one way by which kernels are compiled here.

Numba knows a kept kernel by the source of its own file. A kernel that takes in another file's kernel, or names its
constant, would be used on after an edit of that file alone, and a search would go on by the old rule. So each state of
the sources has a folder of its own, named by a hash of every file that speaks of numba, of all that these import, and
of the compilers' versions. What numba finds there was made from these very sources.

Numba unpickles what it finds and runs the machine code in it. A folder that another user owns or may write, or that is
a link, is refused before numba is told of it. Where no folder can be written, one lives as long as the process.

What is compiled twice is waited for twice on a new machine. Numba compiles a kernel once more for read-only arrays:
whoever calls one from Python hands over a copy. It does so for an integer constant that one kernel hands to another,
which it types as this very number: there ``np.int64(0)`` stands for 0. And an array assigned to part of another brings
the text of an error with it, two seconds of kernels for characters: inside kernels such parts are filled by a loop.
"""

import atexit
import hashlib
import json
import os
import shutil
import tempfile
import time
import warnings
import zlib
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numba as nb

from puncture_twin.planning.base.cache.entry_file import check_own_folder
from puncture_twin.planning.base.cache.source_stamp import files_unedited, library_versions, sources_with, stamp_of
from puncture_twin.planning.base.errors import CacheWarning
from puncture_twin.planning.base.files import atomic

__all__ = ["allocation_free", "nb"]
config: Any = nb.config
"""Numba's settings, which make their attributes when they are loaded."""
FOLDER_VARIABLE = "NUMBA_CACHE_DIR"
"""Numba's own: what the user says with it is the place of all folders. Processes that this one begins learn it so."""
LOCATORS = "UserProvidedCacheLocator,IPythonCacheLocator"
"""Numba's names: that place alone, and what a notebook's cells have. It would go on to folders of other states."""
PREFIX = "kernels-"
COMPILERS = ("numba", "llvmlite", "numpy")
"""Libraries whose versions decide what is compiled."""
KEPT_FOLDERS = 4
KEPT_S = 7 * 86_400.0
"""Folders of other sources stay while they are among the newest, or were used within a week: checkouts share them."""
ENDINGS = (".nbi", ".nbc")
"""Endings of numba's indices and data; it writes under another name first."""
LAST_BYTE = b"."
"""Last byte of every pickle: a file that ends otherwise was cut, as by a system that went down while it was written."""
SUMS = "sums.json"
"""What the folder's files were when a process that had used them ended: size, time and CRC-32. A bit that flips later
is seen before the code runs; that costs 10 ms for the 17 MB of all commands."""


def _use_folder() -> None:
    """Tell numba of the folder; by the environment too, which it reads again when another of its settings changes."""
    sources = tuple(sources_with(b"numba"))
    stamped = f"{stamp_of(sources)} {library_versions(COMPILERS)}"
    name = PREFIX + hashlib.sha256(stamped.encode()).hexdigest()[:32]
    try:
        folder = _own_folder(_place() / name)
    except (OSError, RuntimeError) as error:  # the latter where the user has no home
        warnings.warn(f"cache: kernels are compiled for this run only ({error})", CacheWarning, stacklevel=2)
        place = Path(tempfile.mkdtemp(prefix="puncture-twin-"))
        atexit.register(shutil.rmtree, place, ignore_errors=True)
        folder = _own_folder(place / name)
    atexit.register(_end, folder, sources)
    os.environ[FOLDER_VARIABLE] = config.CACHE_DIR = str(folder)
    config.CACHE_LOCATOR_CLASSES = os.environ["NUMBA_CACHE_LOCATOR_CLASSES"] = LOCATORS


def _place() -> Path:
    """Place of the folders: as the user tells numba, else in their folder for caches."""
    stated = os.environ.get(FOLDER_VARIABLE)
    if stated:
        place = Path(stated).absolute()
        return place.parent if place.name.startswith(PREFIX) else place  # the process that began this one stated it
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "puncture-twin"


def _own_folder(folder: Path) -> Path:
    """The folder, made if need be, the user's own, without what was cut."""
    if not folder.is_dir():
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        check_own_folder(folder)
        with suppress(FileNotFoundError):  # another process removes them too
            others = (one for one in folder.parent.glob(f"{PREFIX}*") if one != folder)
            used = sorted(((one.lstat().st_mtime, one) for one in others), reverse=True)
            for when, one in used[KEPT_FOLDERS:]:
                if time.time() - when > KEPT_S:
                    shutil.rmtree(one, ignore_errors=True)
    check_own_folder(folder)
    tempfile.TemporaryFile(dir=folder).close()
    os.utime(folder)
    for file in _damaged(folder):
        file.unlink(missing_ok=True)
        what = "cache: a compiled kernel is cut or damaged; it is compiled again and replaced"
        warnings.warn(what, CacheWarning, stacklevel=1)
    return folder


State = list[int]
"""A file's size and time, then its sum where that is known."""


def _files(folder: Path) -> dict[str, State]:
    """Numba's files in a folder, each with size and time."""
    found = {}
    for place, _, names in os.walk(folder):
        for file in (f"{place}/{name}" for name in names if name.endswith(ENDINGS)):
            with suppress(FileNotFoundError):  # another process replaces it
                status = os.stat(file)  # noqa: PTH116  # a path of each costs 0.01 s
                found[file] = [status.st_size, status.st_mtime_ns]
    return found


def _sums(folder: Path) -> dict[str, State]:
    """Known states of the files: none, where the list cannot be read."""
    try:
        return {file: [*map(int, known)] for file, known in dict(json.loads((folder / SUMS).read_bytes())).items()}
    except (OSError, ValueError, TypeError):
        return {}


def _damaged(folder: Path) -> Iterator[Path]:
    """Files that differ from their known state, and unknown ones that were cut."""
    sums = _sums(folder)
    for file, state in _files(folder).items():
        with suppress(FileNotFoundError), open(file, "rb") as stream:  # noqa: PTH123  # as above
            content = stream.read()
            known = sums.get(file, [])
            if [*state, zlib.crc32(content)] != known if known[:2] == state else not content.endswith(LAST_BYTE):
                yield Path(file)


def _end(folder: Path, sources: tuple[str, ...]) -> None:
    """Keep the sums of new files; or remove the folder, if sources were edited meanwhile: which did this one load?"""
    if not files_unedited(sources):
        shutil.rmtree(folder, ignore_errors=True)
        return
    sums, files = _sums(folder), _files(folder)
    if {file: known[:2] for file, known in sums.items()} != files:
        with suppress(OSError):  # the next one that ends keeps them
            for file, state in files.items():
                if sums.get(file, [])[:2] != state:
                    sums[file] = [*state, zlib.crc32(Path(file).read_bytes())]
            with atomic(folder / SUMS) as draft:
                draft.write_text(json.dumps({file: sums[file] for file in files}), "utf-8")


_use_folder()

UNCOUNTED: dict[str, Any] = {"_nrt": False} if nb.version_info.short <= (0, 68) else {}
"""Numba's option of that meaning, in versions that were tried: it is no public one. Without it answers are the same, a
search takes a third more and compiling half. Arrays without a counter, which an intrinsic of public names can hand on,
buy two thirds of that in the smallest kernel (.49 s plain, .15 so, .01 with the option)."""
allocation_free: Any = partial(nb.njit, cache=True, **UNCOUNTED)
"""Compile a kernel that makes no array: all that it works on, and works in, its caller owns.

Other kernels count how often each array is in use, with locked instructions, for each array of each tuple that is
handed on, taken apart or cut: of a kernel that asks a few flops of many arrays that is most of its time. Numba refuses
to compile one of these that makes an array.
"""
