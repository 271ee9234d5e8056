"""The cache's folder: bounded in size, the least recently used goes first, and nothing of older versions stays."""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from puncture_twin.planning.base.files import atomic

SUFFIX = ".arrays"
ENTRY = re.compile(r"(?P<maker>[\w.]+)\.(?P<generation>[0-9a-f]{16})\.[0-9a-f]{64}\.arrays")
OF_LAYOUT_1 = re.compile(r"[0-9a-f]{64}\.npz")
TEMPORARY = re.compile(r"\..+\.arrays|\.[0-9a-f]{64}-\w+\.npz")
DEAD_AFTER_S = 24 * 3600.0
"""A temporary file of this age belongs to a process that was killed."""


class StoredFile(NamedTuple):
    """The name of an entry.

    Attributes:
        maker: The module that makes it.
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
    if found is None:
        return OF_LAYOUT_1.fullmatch(name) is not None
    return found["maker"] == entry.maker and found["generation"] != entry.generation


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
