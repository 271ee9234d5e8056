"""A hash of the source code that makes a result: of some modules of this project, and of all that they import from it.

What is kept from one run to the next (surfaces, compiled kernels) is trusted only by code that would make it again.
"""

import hashlib
import os
import re
from collections.abc import Iterable
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGE = Path(__file__).parents[3]
"""The folder of the parts: that of ``puncture_twin`` where it is installed, in a checkout the one around it."""
PROJECT = str(PACKAGE)
"""Files are named by text here: a thousand names are asked for, and few are files."""
PARTS = ("planning", "twin")
IMPORTED = re.compile(
    rb"^[ \t]*(?:from|import)[ \t]+puncture_twin((?:\.\w+)*)(?:[ \t]+import[ \t]+(\([^)]*\)|[^\n#]*))?", re.M
)
"""An import: a module, and the names taken from it. One in a docstring counts too: it costs nothing but a result made
anew."""


def source_stamp(module: str) -> str:
    """The hash of a module's source and of all that it imports from the project, directly or through others.

    Raises ModuleNotFoundError: it is no file: what it makes could not be told from what another version makes.
    """
    files = list(_files_of(module))
    if not files:
        raise ModuleNotFoundError(f"no source of {module} in {PROJECT}")
    return stamp_of(files)


def sources_with(word: bytes) -> list[str]:
    """The project's source files that contain a word."""
    matches = list[str]()
    for place, folders, files in (one for part in PARTS for one in os.walk(PACKAGE / part)):
        folders[:] = (name for name in folders if name != "__pycache__")
        sources = (f"{place}/{name}" for name in files if name.endswith(".py"))
        matches += [file for file in sources if word in _source(file)]
    return matches


def stamp_of(files: Iterable[str]) -> str:
    """The hash of these source files and of all that they import from the project."""
    stamp = hashlib.sha256()
    for file in sorted(closure(files)):
        stamp.update(file.removeprefix(PROJECT).encode() + _source_digest(file))
    return stamp.hexdigest()


def closure(files: Iterable[str]) -> frozenset[str]:
    """The files themselves and all that they import from the project, directly or through others."""
    waiting, taken = list(files), set[str]()
    while waiting:
        file = waiting.pop()
        if file not in taken:
            taken.add(file)
            waiting += _imported(file)
    return frozenset(taken)


def module_unedited(module: str) -> bool:
    """Whether a module's files are still those of its stamp: see `files_unedited`."""
    return files_unedited(_files_of(module))


def files_unedited(files: Iterable[str]) -> bool:
    """Whether these files, and all that they import, are still those that were read for a stamp.

    A module that is loaded after an edit is not the one that was stamped: what it makes must not be kept. A file that
    was written again counts as edited, whatever it says now: who knows what it said in between.
    """
    try:
        return all(_state(os.stat(file)) == _opened(file)[1] for file in closure(files))  # noqa: PTH116  # as above
    except FileNotFoundError:
        return False


def library_versions(libraries: Iterable[str]) -> dict[str, str]:
    """The version of each library that is installed."""
    return {name: _version(name) for name in libraries}


@cache
def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


@cache
def _opened(file: str) -> tuple[bytes, tuple[int, ...]]:
    """A source's bytes, and its state when it was read."""
    with open(file, "rb") as stream:  # noqa: PTH123  # a path of each costs 0.01 s
        return stream.read(), _state(os.fstat(stream.fileno()))


def _state(status: os.stat_result) -> tuple[int, ...]:
    """State of a file that changes whenever it is written or replaced."""
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _source(file: str) -> bytes:
    return _opened(file)[0]


@cache
def _source_digest(file: str) -> bytes:
    return hashlib.sha256(_source(file)).digest()


@cache
def _imported(file: str) -> tuple[str, ...]:
    """The project's files that a file imports; a room hands on no name of its own."""
    files: list[str] = []
    for place, names in IMPORTED.findall(_source(file)):
        module = f"puncture_twin{place.decode()}"
        files += _files_of(module)
        files += [one for name in re.findall(rb"\w+", names) for one in _files_of(f"{module}.{name.decode()}")]
    return tuple(files)


@cache
def _files_of(module: str) -> tuple[str, ...]:
    package, _, rest = module.partition(".")
    if package != "puncture_twin":
        return ()
    place = f"{PROJECT}/{rest.replace('.', '/')}"
    files = f"{place}.py", f"{place}/__init__.py"
    return tuple(file for file in files if os.path.isfile(file))  # noqa: PTH113  # a path of each costs 0.01 s
