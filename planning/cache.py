"""Arrays that cost time to make, kept by the hash of what they were made from.

The folder may be deleted at any time. A file in it is used only if its name is the hash of the inputs and the code's
version, and its content has the hash that it says (which covers the name); anything else is made anew and replaced.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.errors import InputError
from planning.files import atomic

Arrays = dict[str, NDArray[Any]]

FOLDER_VARIABLE = "PUNCTURE_TWIN_CACHE"
"""Environment variable that names the folder; empty switches the cache off."""

LAYOUT = 1
"""Raised whenever what is stored, or how it is made, changes."""

UNREADABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
"""What numpy and zipfile raise for a cut or foreign file."""


@dataclass(frozen=True)
class Cache:
    """A folder of arrays, or no folder at all.

    Attributes:
        folder: Where; None makes everything anew each time.
    """

    folder: Path | None

    def arrays(self, made_from: Mapping[str, Any], make: Callable[[], Arrays]) -> Arrays:
        """The arrays that ``make`` gives, from the folder if they are there.

        Args:
            made_from: Everything that decides the result: hashes of inputs, labels, options. Plain values.
            make: Makes the arrays.
        """
        if self.folder is None:
            return make()
        key = _key(made_from)
        path = self.folder / f"{key}.npz"
        found = _read(path, key)
        if found is None:
            found = make()
            _write(found, path, key)
        return found


NO_CACHE = Cache(None)
"""Makes everything anew."""


def user_cache() -> Cache:
    """This user's cache: ``$PUNCTURE_TWIN_CACHE``, else ``puncture-twin`` under ``$XDG_CACHE_HOME`` or ``~/.cache``."""
    named = os.environ.get(FOLDER_VARIABLE)
    if named is not None:
        return Cache(Path(named) if named else None)
    base = os.environ.get("XDG_CACHE_HOME")
    return Cache((Path(base) if base else Path.home() / ".cache") / "puncture-twin")


@cache
def _version() -> str:
    """Of this package; reading it takes a millisecond, and a case has a hundred surfaces."""
    return version("puncture-twin")


def _key(made_from: Mapping[str, Any]) -> str:
    whole = {"layout": LAYOUT, "version": _version(), "numpy": np.__version__, **made_from}
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()


def _digest(arrays: Arrays, key: str) -> str:
    digest = hashlib.sha256(key.encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _read(path: Path, key: str) -> Arrays | None:
    """The arrays, or None where the file is missing, cut, foreign or not what it says."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        said = str(arrays.pop("digest"))
    except UNREADABLE:
        return None
    return arrays if said == _digest(arrays, key) else None


def _write(arrays: Arrays, path: Path, key: str) -> None:
    """Store the arrays; a folder that cannot be written costs time, not the result."""
    try:
        with atomic(path) as temporary, temporary.open("wb") as stream:
            stored: dict[str, Any] = {"digest": np.array(_digest(arrays, key)), **arrays}
            np.savez(stream, **stored)
    except (OSError, InputError):
        return
