"""Arrays that cost time to make, kept by the hash of what they were made from and of the code that made them.

The folder may be deleted at any time. An entry is used only if its digest covers its content and its key: the hashes
of all inputs, the parameters, the source of the module that makes it with all that it imports, and the versions of the
libraries. Anything else is made anew and replaced, and a `CacheWarning` says so.

What one process keeps of values that cost time to make, from one case to the next.

The folder is bounded in size: the least recently used goes first, and nothing of older versions stays.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shutil
import time
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any, Generic, NamedTuple, TypeVar

from puncture_twin.planning.base.cache.entry_file import (
    Arrays,
    DamagedError,
    check_own,
    packed,
    read_plain_file,
    unpacked,
)
from puncture_twin.planning.base.cache.source_stamp import library_versions, module_unedited, source_stamp
from puncture_twin.planning.base.errors import CacheWarning, InputError, refuse
from puncture_twin.planning.base.files import atomic

SUFFIX = ".arrays"
ENTRY = re.compile(r"(?P<maker>[\w.]+)\.(?P<generation>[0-9a-f]{16})\.[0-9a-f]{64}\.arrays")
TEMPORARY = re.compile(r"\..+\.arrays")
DEAD_AFTER_S = 24 * 3600.0
"""A temporary file of this age belongs to a process that was killed."""


class StoredFile(NamedTuple):
    """The name of an entry.

    Attributes:
        generation: 16 hexadecimal digits of its source and the libraries' versions.
        key: 64 of all that decides its content.
    """

    maker: str
    generation: str
    key: str

    @property
    def file(self) -> str:
        """The name of its file."""
        return f"{self.maker}.{self.generation}.{self.key}{SUFFIX}"


class _Kept(NamedTuple):
    used_ns: int
    size: int
    path: Path


def store(folder: Path, entry: StoredFile, content: bytes, most_bytes: int) -> None:
    """Write an entry, whole or not at all; then make the folder fit again.

    Raises:
        OSError, InputError: The folder cannot be written to.
    """
    if len(content) > most_bytes:
        return
    path = folder / entry.file
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    with atomic(path) as temporary:
        temporary.write_bytes(content)
    tidy(folder, entry, most_bytes)


def touch(path: Path) -> None:
    """Note that an entry was used."""
    try:
        os.utime(path)
    except OSError:  # another process has removed it, or it is another user's
        return


def tidy(folder: Path, entry: StoredFile, most_bytes: int) -> None:
    """Remove what this version of the maker cannot use, what the dead have left, and the oldest beyond the bound."""
    kept = []
    for one in _files(folder):
        if _outlived(one, entry):
            _remove(one.path)
        elif ENTRY.fullmatch(one.path.name):
            kept.append(one)
    total = sum(one.size for one in kept)
    for one in sorted(kept):
        if total <= most_bytes:
            break
        _remove(one.path)
        total -= one.size


def _outlived(one: _Kept, entry: StoredFile) -> bool:
    name = one.path.name
    if TEMPORARY.fullmatch(name):
        return time.time() - one.used_ns / 1e9 > DEAD_AFTER_S
    found = ENTRY.fullmatch(name)
    return found is not None and found["maker"] == entry.maker and found["generation"] != entry.generation


def _files(folder: Path) -> Iterator[_Kept]:
    """The plain files of the folder; one that another process removes meanwhile is passed over."""
    with os.scandir(folder) as found:
        for one in found:
            try:
                if one.is_file(follow_symlinks=False):
                    seen = one.stat(follow_symlinks=False)
                    yield _Kept(seen.st_mtime_ns, seen.st_size, Path(one.path))
            except OSError:
                continue


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:  # not ours to remove
        return


Value = TypeVar("Value")

MEMORY_BYTES = 500_000_000
"""What is kept of patients, also beside a search: the meshes and trees of some ten whole bodies."""


class Memory:
    """Values by key, bounded in size: the least recently used goes first.

    A key holds the maker's name, the hashes of all bytes that the value is made from, and every option that decides it;
    never a path. A value is not changed after it was made. What raises is not kept. Threads may share one.

    Args:
        most_bytes: What the values may hold together; 0 keeps nothing.
    """

    def __init__(self, most_bytes: int = 0) -> None:
        self._most = most_bytes
        self._held = 0
        self._lock = Lock()
        self._kept: OrderedDict[tuple[Hashable, ...], tuple[Any, int]] = OrderedDict()

    def __reduce__(self) -> tuple[Any, ...]:
        """For another process: an empty one."""
        return Memory, (self._most,)

    @property
    def held_bytes(self) -> int:
        """Bytes that the values hold now."""
        return self._held

    def get(self, key: tuple[Hashable, ...], make: Callable[[], Value], size: Callable[[Value], int]) -> Value:
        """The value of a key, made where it is not there.

        Args:
            size: About how many bytes it holds.
        """
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key][0]
        value = make()
        with self._lock:
            self._keep(key, value, size(value))
        return value

    def holds(self, key: tuple[Hashable, ...]) -> bool:
        """Whether the value of a key is there."""
        return key in self._kept

    @property
    def most_bytes(self) -> int:
        """Bytes that the values may hold."""
        return self._most

    def _keep(self, key: tuple[Hashable, ...], value: Any, size: int) -> None:
        if size > self._most or key in self._kept:  # another thread has made it too
            return
        self._kept[key] = value, size
        self._held += size
        while self._held > self._most:
            _, (_, gone) = self._kept.popitem(last=False)
            self._held -= gone


NO_MEMORY = Memory()
"""Makes everything anew."""


FOLDER_VARIABLE = "PUNCTURE_TWIN_CACHE"
"""Environment variable that names the folder; empty switches the cache off."""

SIZE_VARIABLE = "PUNCTURE_TWIN_CACHE_MB"
"""Environment variable with the most megabytes (of 1,000,000 bytes) that the folder may hold."""

MOST_BYTES = 2_000_000_000
"""Where it says nothing: the surfaces of some twenty whole bodies."""

LIBRARIES = (
    *("puncture-twin", "numpy", "scipy", "scikit-image", "numba", "llvmlite", "python-fcl", "trimesh"),
    *("fast-simplification", "pillow", "pyarrow", "pydantic", "pydicom", "python-gdcm", "h5py"),
)
"""Whose versions decide what is made."""


@dataclass(frozen=True)
class _Read(Generic[Value]):
    """Arrays, and what was read from them."""

    arrays: Arrays
    value: Value


@dataclass(frozen=True)
class Cache:
    """A folder of arrays, or no folder at all.

    Attributes:
        folder: Where; None makes everything anew each time.
        memory: What this process keeps beside it.
    """

    folder: Path | None
    most_bytes: int = MOST_BYTES
    memory: Memory = field(default=NO_MEMORY, compare=False)

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
        """The value that ``read`` makes of `arrays`; reading is their check too, so a mesh is guarded once.

        Args:
            read: Raises ValueError, KeyError, TypeError or InputError for arrays that cannot be what ``make`` gives.
        """
        if self.memory is NO_MEMORY:
            if self.folder is None:
                return read(_frozen(make()))
            return self._from_folder(_entry(made_from, by), make, read).value
        entry = _entry(made_from, by)
        return self.memory.get((__name__, entry), lambda: self._from_folder(entry, make, read), _size).value

    def _from_folder(
        self, entry: StoredFile, make: Callable[[], Arrays], read: Callable[[Arrays], Value]
    ) -> _Read[Value]:
        found = None if self.folder is None else _kept(self.folder / entry.file, entry.key, read)
        if found is None:
            made = _frozen(make())
            found = _Read(made, read(made))
            if self.folder is not None and module_unedited(entry.maker):  # else it may be of newer code than its stamp
                self._store(entry, made)
        return found

    def _store(self, entry: StoredFile, arrays: Arrays) -> None:
        """Store the arrays; a folder that cannot be written to costs time, not the result."""
        assert self.folder is not None  # the caller has asked
        try:
            store(self.folder, entry, packed(arrays, entry.key), self.most_bytes)
        except (OSError, InputError):
            return


NO_CACHE = Cache(None)
"""Makes everything anew."""


def user_cache() -> Cache:
    """This user's cache: ``$PUNCTURE_TWIN_CACHE``, else ``puncture-twin`` under ``$XDG_CACHE_HOME`` or ``~/.cache``.

    Raises:
        InputError: ``$PUNCTURE_TWIN_CACHE_MB`` is no number.
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
    """Read-only, as arrays from the folder are: several will hold them, and kernels are compiled for one kind alone."""
    for array in arrays.values():
        array.setflags(write=False)
    return arrays


def _size(found: _Read[Any]) -> int:
    """Of the arrays, which the value looks at."""
    return sum(array.nbytes for array in found.arrays.values())


def _entry(made_from: Mapping[str, Any], by: str) -> StoredFile:
    generation = _generation(by)
    key = hashlib.sha256(json.dumps({"generation": generation, **made_from}, sort_keys=True).encode()).hexdigest()
    return StoredFile(by, generation[:16], key)


@cache
def _generation(by: str) -> str:
    """Hash of all code that a module's results depend on; it takes milliseconds, so it is made once a process."""
    parts = {"source": source_stamp(by), "python": platform.python_version(), **library_versions(LIBRARIES)}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def _kept(path: Path, key: str, read: Callable[[Arrays], Value]) -> _Read[Value] | None:
    """The arrays of an entry; None where there is no entry, or, with a note, a damaged one."""
    check_own(path)
    try:
        arrays = unpacked(read_plain_file(path), key)
        found = _Read(arrays, read(arrays))
    except FileNotFoundError:
        return None
    except (DamagedError, ValueError, KeyError, TypeError, InputError) as error:
        why = error if isinstance(error, DamagedError) else "does not have the expected content"
        warnings.warn(f"cache: a stored result {why}; it is computed again and replaced", CacheWarning, stacklevel=1)
        return None
    touch(path)
    return found
