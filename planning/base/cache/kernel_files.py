"""Numba's files of compiled kernels, behind digests: what is cut, damaged or swapped is compiled anew.

Numba reads its files as pickles and runs the machine code in them without a check. Each file here starts with a digest
of its name, its stamp and its content, which is checked before anything is unpickled.
"""

# mypy: disable-error-code="no-untyped-call, misc"
# numba has no types

from __future__ import annotations

import glob
import hashlib
import io
import itertools
import pickle
import re
import shutil
import sys
import warnings
from pathlib import Path
from typing import Any

from numba.core import caching
from numba.core.environment import Environment, _rebuild_env, lookup_environment

from puncture_twin.planning.base.cache.entry_file import DamagedError, check_own, read_plain_file
from puncture_twin.planning.base.errors import CacheWarning

NumbasFiles: Any = caching.IndexDataCacheFile
"""Numba's own reader and writer of an index and its data files."""

MAGIC = b"puncture-twin kernel 1\n"
DIGEST_BYTES = 32
OWN = ".checked"
"""In the names of these files, so that numba's own, which have no digest, are never taken for them."""

FUNCTION = re.compile(r"(?P<name>.*)-\d+\.py\w+\.checked")
"""A file's name without its ending: the function, its line, the Python version."""


class CheckedFiles(NumbasFiles):
    """The index and the data files of one function, each behind a digest.

    They are written into the one place that numba has chosen, and read there and then in what the package brings.

    Args:
        cache_path: That place.
        filename_base: The beginning of the files' names.
        stamp: Of the sources that the function is made of.
        brought: Where the package may bring compiled code of the same function, under the same names of files.
    """

    def __init__(self, cache_path: str, filename_base: str, stamp: str, brought: Path | None) -> None:
        super().__init__(cache_path=cache_path, filename_base=filename_base + OWN, source_stamp=stamp)
        self._folder = Path(cache_path)
        self._folders = [self._folder, *([brought] if brought else [])]
        self._base = filename_base + OWN

    def load(self, key: Any) -> Any:
        """What was saved under a key, or None."""
        found = (self._load_from(folder, key) for folder in self._folders)
        return next((data for data in found if data is not None), None)

    def _load_from(self, folder: Path, key: Any) -> Any:
        name = self._load_index(folder).get(key)
        content = None if name is None else self._content(folder / name)
        if content is None:
            return None
        stated, data = _Unpickler(io.BytesIO(content)).load()
        return data if stated == key else None

    def any_kept(self) -> bool:
        """Whether the function has been compiled for anything under today's sources."""
        return any(self._load_index(folder, report=False) for folder in self._folders)

    def save(self, key: Any, data: Any) -> None:
        """Save under a key; a folder that cannot be written to costs time, not the result."""
        overloads = self._load_index(self._folder, report=False)
        taken = set(overloads.values())
        free = (self._data_name(number) for number in itertools.count(1))
        name = overloads.get(key) or next(name for name in free if name not in taken)
        try:
            self._write(name, self._dump((key, data)))
            self._save_index({**overloads, key: name})
            self._remove_older()
        except OSError:
            return

    def _load_index(self, folder: Path, *, report: bool = True) -> dict[Any, str]:
        content = self._content(folder / self._index_name, report=report)
        return {} if content is None else pickle.loads(content)

    def _save_index(self, overloads: dict[Any, str]) -> None:
        self._write(self._index_name, self._dump(overloads))

    def _content(self, file: Path, *, report: bool = True) -> bytes | None:
        """The content of a file, or None where it is not there, of other sources or, which is said, not whole.

        Raises:
            InputError: Another user owns it, or may write it.
        """
        check_own(file)
        try:
            stored = read_plain_file(file)
        except FileNotFoundError:
            return None
        except DamagedError as error:
            _report(str(error), report)
            return None
        stamp, digest, content = _split(stored)
        if digest != _digest(file.name, stamp, content):
            _report("is cut, damaged, or another's", report)
            return None
        return content if stamp == self._stamp else None

    @property
    def _stamp(self) -> bytes:
        return hashlib.sha256(self._source_stamp.encode()).digest()

    def _write(self, name: str, content: bytes) -> None:
        path = self._folder / name
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        with self._open_for_write(str(path)) as stream:
            stream.write(MAGIC + self._stamp + _digest(name, self._stamp, content) + content)

    def _remove_older(self) -> None:
        """Remove what the same function has left at other lines and under other sources."""
        function = FUNCTION.fullmatch(self._base)
        if function is None:
            return
        for index in self._folder.glob(f"{glob.escape(function['name'])}-*.nbi"):
            if index.name != self._index_name and not self._current(index):
                for file in (index, *self._folder.glob(f"{glob.escape(index.stem)}.*.nbc")):
                    file.unlink(missing_ok=True)

    def _current(self, index: Path) -> bool:
        try:
            return _split(read_plain_file(index))[0] == self._stamp  # nothing is unpickled
        except (FileNotFoundError, DamagedError):
            return False


class _Unpickler(pickle.Unpickler):
    """Loads what numba has pickled, without the modules of numba that only compiling needs."""

    def find_class(self, module: str, name: str) -> Any:
        """What stands for a name in the file."""
        rebuild = (module, name) == (_rebuild_env.__module__, _rebuild_env.__name__)
        return _environment if rebuild else super().find_class(module, name)


def _environment(module: str, consts: list[Any], name: str) -> Any:
    """What a compiled function knows of its module; of numba's own that is nothing but the name.

    Only code in object mode looks names up there, and kernels have none. Numba would import the module.
    """
    known = lookup_environment(name)
    if known is not None or not module.startswith("numba.") or module in sys.modules or consts:
        return known or _rebuild_env(module, consts, name)
    environment = Environment({"__name__": module})
    environment.env_name = name
    Environment._memo[name] = environment
    return environment


def _split(stored: bytes) -> tuple[bytes, bytes, bytes]:
    """Stamp, digest and content of a file; no digest where it is none of these files."""
    if not stored.startswith(MAGIC):
        return b"", b"", b""
    stamp, digest, content = (len(MAGIC) + DIGEST_BYTES * parts for parts in range(3))
    return stored[stamp:digest], stored[digest:content], stored[content:]


def _digest(name: str, stamp: bytes, content: bytes) -> bytes:
    digest = hashlib.sha256(name.encode() + b"\n" + stamp)
    digest.update(content)
    return digest.digest()


def _report(why: str, report: bool) -> None:
    if report:
        warnings.warn(f"cache: a compiled kernel {why}; it is compiled anew and replaced", CacheWarning, stacklevel=1)
