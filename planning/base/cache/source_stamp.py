"""A hash of the source code that makes a result: of some modules of this project, and of all that they import from it.

What is kept from one run to the next (surfaces, compiled kernels) is trusted only by code that would make it again.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGE = Path(__file__).parents[3]
"""The folder of the parts: that of ``puncture_twin`` where it is installed, in a checkout the one around it."""

PROJECT = str(PACKAGE)
"""Files are named by text here: a thousand names are asked for, and few are files."""

PARTS = ("planning", "twin")

IMPORTED = re.compile(
    rb"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n#]*)|import[ \t]+([^\n#]*))", re.M
)
"""An import: the module and the names taken from it, or a list of modules. One in a docstring counts too: it costs
nothing but a result made anew."""

NAME = re.compile(rb"([\w.]+|\*)(?:[ \t]+as[ \t]+\w+)?")


def source_stamp(module: str) -> str:
    """The hash of a module's source and of all that it imports from the project, directly or through others.

    Args:
        module: Its name, such as ``puncture_twin.planning.anatomy.surfaces``.

    Raises:
        ModuleNotFoundError: The project has no such module as a file: what it makes could not be told from what
            another version makes.
    """
    files = list(_files_of(module))
    if not files:
        raise ModuleNotFoundError(f"no source of {module} in {PROJECT}")
    return stamp_of(files)


def sources_with(word: bytes) -> list[str]:
    """The project's source files in which a word stands."""
    return [file for part in PARTS for file in _sources_in(PACKAGE / part) if word in _source(file)]


def _sources_in(folder: Path) -> Iterator[str]:
    for place, folders, files in os.walk(folder):
        folders[:] = (name for name in folders if name != "__pycache__")
        yield from (f"{place}/{name}" for name in files if name.endswith(".py"))


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
    """The project's files that a file imports, and those whose names a package hands on without an import."""
    found = list(_handed_on(file))
    for module, names, modules in _imports(_source(file)):
        if module:
            place = _absolute(module.decode(), file)
            found += [one for name in NAME.findall(names) for one in _files_of_name(place, name.decode())]
        else:
            found += [one for name in NAME.findall(modules) for one in _files_of(name.decode())]
    return tuple(found)


def _handed_on(file: str) -> tuple[str, ...]:
    """The stub beside a package's own file, which says where each of its names is made, and the package's modules.

    They are loaded when a name is asked for, as an attribute too: no import need name it.
    """
    folder, _, name = file.rpartition("/")
    if name != "__init__.py":
        return ()
    stub = f"{file}i"
    stubs = (stub,) if os.path.isfile(stub) else ()  # noqa: PTH113  # a path of each costs 0.01 s
    return (*stubs, *sorted(map(str, Path(folder).glob("*.py"))))


def _absolute(module: str, file: str) -> str:
    """The name of a module that a file may name from its own place, by leading dots."""
    name = module.lstrip(".")
    dots = len(module) - len(name)
    if not dots:
        return module
    place = file.removeprefix(f"{PROJECT}/").split("/")[:-dots]
    return ".".join(part for part in ("puncture_twin", *place, name) if part)


def _imports(source: bytes) -> Iterator[tuple[bytes, bytes, bytes]]:
    """The imports in a source by `IMPORTED`, which is tried where the word occurs, not at every line."""
    at = source.find(b"import")
    while at >= 0:
        found = IMPORTED.match(source, source.rfind(b"\n", 0, at) + 1)
        if found:
            yield found.group(1) or b"", found.group(2) or b"", found.group(3) or b""
        at = source.find(b"import", at + 1 if found is None else max(at + 1, found.end()))


def _files_of_name(module: str, name: str) -> tuple[str, ...]:
    """The files behind ``from module import name``: a module, or a name of a module."""
    return _files_of(f"{module}.{name}") or _files_of(module)


@cache
def _files_of(module: str) -> tuple[str, ...]:
    package, _, rest = module.partition(".")
    if package != "puncture_twin":
        return ()
    place = f"{PROJECT}/{rest.replace('.', '/')}"
    files = f"{place}.py", f"{place}/__init__.py"
    return tuple(file for file in files if os.path.isfile(file))  # noqa: PTH113  # a path of each costs 0.01 s
