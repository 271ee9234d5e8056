"""The cache of computed arrays, keyed by the hash of what they were made from and of the code that made them.

The folder may be deleted at any time. An entry is used only if its digest covers its content and its key: the hashes
of all inputs, the parameters, the source of the module that makes it with all that it imports, and the versions of the
libraries. Anything else is made anew and replaced, and a `CacheWarning` says so. Folder and memory are bounded in size:
the least recently used goes first, and nothing of older versions stays.
"""

import hashlib
import json
import os
import platform
import re
import shutil
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any, Generic, NamedTuple, TypeVar

from puncture_twin.planning.base.cache import entry_file
from puncture_twin.planning.base.cache.entry_file import Arrays, DamagedError
from puncture_twin.planning.base.cache.source_stamp import library_versions, module_unedited, source_stamp
from puncture_twin.planning.base.errors import CacheWarning, InputError, refuse
from puncture_twin.planning.base.files import atomic

SUFFIX = ".arrays"
ENTRY = re.compile(r"(?P<maker>[\w.]+)\.(?P<generation>[0-9a-f]{16})\.[0-9a-f]{64}\.arrays")
TEMPORARY = re.compile(r"\..+\.arrays")
DEAD_AFTER_S = 24 * 3600.0
"""A temporary file of this age belongs to a process that was killed."""


class StoredFile(NamedTuple):
    """Name of a cache entry: the module that made it, that module's generation, and the key of its content."""

    maker: str
    generation: str  # 16 hexadecimal digits of its source and the libraries' versions
    key: str  # 64 of all that decides its content

    @property
    def file(self) -> str:
        """The entry's file name."""
        return f"{self.maker}.{self.generation}.{self.key}{SUFFIX}"


def store(folder: Path, entry: StoredFile, content: bytes, most_bytes: int) -> None:
    """Write an entry, whole or not at all, then bound the folder. Raises OSError, InputError: it cannot be written."""
    if len(content) > most_bytes:
        return
    path = folder / entry.file
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    with atomic(path) as temporary:
        temporary.write_bytes(content)
    _tidy(folder, entry, most_bytes)


def _tidy(folder: Path, entry: StoredFile, most_bytes: int) -> None:
    """Remove what this version of the maker cannot use, what the dead have left, and the oldest beyond the bound."""
    entries: list[tuple[int, int, Path]] = []
    with os.scandir(folder) as listing:
        for file in listing:
            with suppress(OSError):  # another process removes it meanwhile, or it is not ours
                if not file.is_file(follow_symlinks=False):
                    continue
                seen, path = file.stat(follow_symlinks=False), Path(file.path)
                named = ENTRY.fullmatch(file.name)
                if named is None:
                    outlived = bool(TEMPORARY.fullmatch(file.name)) and time.time() - seen.st_mtime > DEAD_AFTER_S
                else:
                    outlived = named["maker"] == entry.maker and named["generation"] != entry.generation
                if outlived:
                    path.unlink(missing_ok=True)
                elif named is not None:
                    entries.append((seen.st_mtime_ns, seen.st_size, path))
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= most_bytes:
            break
        with suppress(OSError):
            path.unlink(missing_ok=True)
        total -= size


Value = TypeVar("Value")
MEMORY_BYTES = 500_000_000
"""Bound of what a process holds of patients, also during a search: the meshes and trees of some ten whole bodies."""


class Memory:
    """Values by key, in ``most_bytes`` together: the least recently used goes first, and 0 keeps nothing.

    A key holds the maker's name, the hashes of all bytes that the value is made from, and every option that decides it;
    never a path. A value is not changed after it was made. What raises is not kept. Threads may share one.
    """

    def __init__(self, most_bytes: int = 0) -> None:
        self._most = most_bytes
        self._held = 0
        self._lock = Lock()
        self._kept: OrderedDict[tuple[Hashable, ...], tuple[Any, int]] = OrderedDict()

    def __reduce__(self) -> tuple[Any, ...]:
        """For pickling: another process gets an empty memory."""
        return Memory, (self._most,)

    @property
    def held_bytes(self) -> int:
        """Bytes that the values hold now."""
        return self._held

    def get(self, key: tuple[Hashable, ...], make: Callable[[], Value], size: Callable[[Value], int]) -> Value:
        """The value of a key, made where it is not there; ``size``: about how many bytes it holds."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key][0]
        value = make()
        with self._lock:
            if (bytes_of_it := size(value)) <= self._most and key not in self._kept:  # another thread has made it too
                self._kept[key] = value, bytes_of_it
                self._held += bytes_of_it
            while self._held > self._most:
                _, (_, gone) = self._kept.popitem(last=False)
                self._held -= gone
        return value

    def contains(self, key: tuple[Hashable, ...]) -> bool:
        """Whether the value of a key is there."""
        return key in self._kept

    @property
    def most_bytes(self) -> int:
        """Bytes that the values may hold."""
        return self._most


NO_MEMORY = Memory()
"""A memory that holds nothing."""
FOLDER_VARIABLE = "PUNCTURE_TWIN_CACHE"
"""Environment variable that names the folder; empty switches the cache off."""
SIZE_VARIABLE = "PUNCTURE_TWIN_CACHE_MB"
"""Environment variable with the most megabytes (of 1,000,000 bytes) that the folder may hold."""
MOST_BYTES = 2_000_000_000
"""Bound where the variable is not set: the surfaces of some twenty whole bodies."""
LIBRARIES = (
    *("puncture-twin", "numpy", "scipy", "scikit-image", "numba", "llvmlite", "python-fcl", "trimesh"),
    *("fast-simplification", "pillow", "pyarrow", "pydantic", "pydicom", "python-gdcm", "h5py"),
)
"""Libraries whose versions decide what is computed."""


@dataclass(frozen=True)
class _Read(Generic[Value]):
    """Arrays, and the value that was read from them."""

    arrays: Arrays
    value: Value


@dataclass(frozen=True)
class Cache:
    """A folder of arrays, or no folder at all."""

    folder: Path | None  # where; None makes everything anew each time
    most_bytes: int = MOST_BYTES
    memory: Memory = field(default=NO_MEMORY, compare=False)  # what this process keeps beside it

    def arrays(
        self,
        made_from: Mapping[str, Any],
        make: Callable[[], Arrays],
        *,
        by: str,
        check: Callable[[Arrays], object] | None = None,
    ) -> Arrays:
        """The arrays that ``make`` gives, read-only, from the folder if they are there and whole.

        Args:
            made_from: Everything that decides the result: hashes of inputs, labels, options. Plain values.
            by: The module whose code makes them, such as ``puncture_twin.planning.anatomy.surfaces``.
            check: Raises ValueError, KeyError, TypeError or InputError for arrays that cannot be what ``make`` gives.
        """

        def checked(arrays: Arrays) -> Arrays:
            if check is not None:
                check(arrays)
            return arrays

        return self.value(made_from, make, checked, by=by)

    def value(
        self, made_from: Mapping[str, Any], make: Callable[[], Arrays], read: Callable[[Arrays], Value], *, by: str
    ) -> Value:
        """The value that ``read`` makes of `arrays`; reading is their check too, so a mesh is guarded once."""
        if self.memory is NO_MEMORY:
            if self.folder is None:
                return read(_frozen(make()))
            return self._from_folder(_entry(made_from, by), make, read).value

        def size(entry_value: _Read[Any]) -> int:
            return sum(array.nbytes for array in entry_value.arrays.values())

        entry = _entry(made_from, by)
        return self.memory.get((__name__, entry), lambda: self._from_folder(entry, make, read), size).value

    def _from_folder(
        self, entry: StoredFile, make: Callable[[], Arrays], read: Callable[[Arrays], Value]
    ) -> _Read[Value]:
        stored = None if self.folder is None else _stored(self.folder / entry.file, entry.key, read)
        if stored is None:
            arrays = _frozen(make())
            stored = _Read(arrays, read(arrays))
            if self.folder is not None and module_unedited(entry.maker):  # else it may be of newer code than its stamp
                with suppress(OSError, InputError):  # a folder that cannot be written to costs time, not the result
                    store(self.folder, entry, entry_file.packed(arrays, entry.key), self.most_bytes)
        return stored


NO_CACHE = Cache(None)
"""A cache without a folder: everything is computed anew."""


def user_cache() -> Cache:
    """The user's cache: ``$PUNCTURE_TWIN_CACHE``, else ``puncture-twin`` in ``$XDG_CACHE_HOME`` or ``~/.cache``.

    Raises InputError: ``$PUNCTURE_TWIN_CACHE_MB`` is no number.
    """
    named = os.environ.get(FOLDER_VARIABLE)
    if named is not None:
        return Cache(Path(named) if named else None, _most_bytes())
    base = os.environ.get("XDG_CACHE_HOME")
    return Cache((Path(base) if base else Path.home() / ".cache") / "puncture-twin", _most_bytes())


def _most_bytes() -> int:
    stated = os.environ.get(SIZE_VARIABLE)
    if not stated:
        return MOST_BYTES
    if not (stated.isascii() and stated.isdigit() and len(stated) < 10):
        refuse(f"{stated[:40]!r} is not a size", f"${SIZE_VARIABLE}", "whole megabytes, such as 2000", "not_a_number")
    return int(stated) * 1_000_000


def _frozen(arrays: Arrays) -> Arrays:
    """The arrays, made read-only like those from the folder: all are shared, and kernels compile for one kind only."""
    for array in arrays.values():
        array.setflags(write=False)
    return arrays


def _entry(made_from: Mapping[str, Any], by: str) -> StoredFile:
    generation = _generation(by)
    key = hashlib.sha256(json.dumps({"generation": generation, **made_from}, sort_keys=True).encode()).hexdigest()
    return StoredFile(by, generation[:16], key)


@cache
def _generation(by: str) -> str:
    """Hash of all code that a module's results depend on; it takes milliseconds, so it is made once a process."""
    parts = {"source": source_stamp(by), "python": platform.python_version(), **library_versions(LIBRARIES)}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def _stored(path: Path, key: str, read: Callable[[Arrays], Value]) -> _Read[Value] | None:
    """The arrays of an entry; None where there is no entry, or, with a note, a damaged one."""
    entry_file.check_own(path)
    try:
        arrays = entry_file.unpacked(entry_file.read_plain_file(path), key)
        stored = _Read(arrays, read(arrays))
    except FileNotFoundError:
        return None
    except (DamagedError, ValueError, KeyError, TypeError, InputError) as error:
        why = error if isinstance(error, DamagedError) else "does not have the expected content"
        warnings.warn(f"cache: a stored result {why}; it is computed again and replaced", CacheWarning, stacklevel=1)
        return None
    with suppress(OSError):  # another process has removed it, or it is another user's
        os.utime(path)  # it was used
    return stored
