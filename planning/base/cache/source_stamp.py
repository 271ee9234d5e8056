"""A hash of the source code that makes a result: of some modules of this project, and of all that they import from it.

What is kept from one run to the next (surfaces, compiled kernels) is trusted only by code that would make it again.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGE = Path(__file__).parents[3]
"""The folder of ``puncture_twin``; not resolved, for in a checkout its parts are links."""

PROJECT = PACKAGE.parent
PARTS = ("planning", "twin")

IMPORTED = re.compile(
    rb"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n#]*)|import[ \t]+([^\n#]*))", re.M
)
"""An import: the module and the names taken from it, or a list of modules. One in a docstring counts too: it costs
nothing but a result made anew."""

NAME = re.compile(rb"([\w.]+)(?:[ \t]+as[ \t]+\w+)?")


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


def stamp_of(files: Iterable[Path]) -> str:
    """The hash of these source files and of all that they import from the project."""
    stamp = hashlib.sha256()
    for path in sorted(closure(files)):
        stamp.update(str(path.relative_to(PROJECT)).encode() + hashlib.sha256(_source(path)).digest())
    return stamp.hexdigest()


def closure(files: Iterable[Path]) -> frozenset[Path]:
    """The files themselves and all that they import from the project, directly or through others."""
    waiting, taken = list(files), set[Path]()
    while waiting:
        path = waiting.pop()
        if path not in taken:
            taken.add(path)
            waiting += _imported(path)
    return frozenset(taken)


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
def _source(path: Path) -> bytes:
    return path.read_bytes()


@cache
def _imported(path: Path) -> tuple[Path, ...]:
    """The project's files that a file imports."""
    found: list[Path] = []
    for module, names, modules in _imports(_source(path)):
        if module:
            found += [file for name in NAME.findall(names) for file in _files_of_name(module.decode(), name.decode())]
        else:
            found += [file for name in NAME.findall(modules) for file in _files_of(name.decode())]
    return tuple(found)


def _imports(source: bytes) -> Iterator[tuple[bytes, bytes, bytes]]:
    """What `IMPORTED` finds in a source: it is tried where the word stands, not at every line."""
    at = source.find(b"import")
    while at >= 0:
        found = IMPORTED.match(source, source.rfind(b"\n", 0, at) + 1)
        if found:
            yield found.group(1) or b"", found.group(2) or b"", found.group(3) or b""
        at = source.find(b"import", at + 1 if found is None else max(at + 1, found.end()))


def _files_of_name(module: str, name: str) -> tuple[Path, ...]:
    """The files behind ``from module import name``: a module, or a name of a module.

    A package may hand on the names of its modules without an import statement; then any of them may be meant.
    """
    if module.partition(".")[0] != PACKAGE.name:
        return ()
    return _files_of(f"{module}.{name}") or (*_files_of(module), *_files_in(module))


@cache
def _files_in(package: str) -> tuple[Path, ...]:
    return tuple(sorted((PROJECT / package.replace(".", "/")).glob("*.py")))


@cache
def _files_of(module: str) -> tuple[Path, ...]:
    if module.partition(".")[0] != PACKAGE.name:
        return ()
    place = PROJECT / module.replace(".", "/")
    return tuple(file for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file())
