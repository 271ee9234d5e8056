"""Provenance of a result: every file that decided it, once, with its role and the hash of the bytes that were parsed.

A path may name other bytes a moment later. So a file is read once, its hash is that of the bytes in memory, and
whoever parses the file parses those bytes.
"""

from __future__ import annotations

import hashlib
import posixpath
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NoReturn

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import absence, is_plain_file, read_input
from puncture_twin.planning.base.strict_json import text

CASE_ROLE = "case"
"""The file that names the others; what it is called decides nothing."""
KEPT_BYTES = 10_000_000
"""Bytes of inputs that stay in memory with a case, the smallest files first: points and names. Volumes, and the many
slices of a series, are let go of once parsed."""


@dataclass(frozen=True, order=True)
class Input:
    """A file that decided a result."""

    role: str  # what it is to the result: ``case``, ``mesh liver``, ``labelmap``, ``labelmap data``, ``markers_ct``,
    path: str  # as the file that names it states it, relative to the case's folder
    sha256: str  # hexadecimal, of the bytes that were read


def inputs_document(inputs: Iterable[Input]) -> list[dict[str, str]]:
    """The list that every result carries: role, path and sha256 of each file, as plain values."""
    return [asdict(one) for one in inputs]


def read_inputs(document: Any) -> tuple[Input, ...]:
    """The list of a result that was read. Raises TypeError, KeyError, ValueError: no list, or one with two hashes."""
    if not isinstance(document, list):
        raise TypeError("inputs is not a list")
    inputs = tuple(Input(*(text(one[key]) for key in ("role", "path", "sha256"))) for one in document)
    if len({_place(one) for one in inputs}) != len({(_place(one), one.sha256) for one in inputs}):
        raise ValueError("an input appears twice, with two hashes")
    return inputs


def differing_input(stated: Sequence[Input], known: Sequence[Input]) -> str | None:
    """The first input in which two lists differ, as its role and path; None where both list the same files.

    The order does not matter, nor how a path is written (``./a.csv`` is ``a.csv``), nor what the case file is called.
    """
    hashes = [{_place(one): one.sha256 for one in some} for some in (stated, known)]
    for role, path in sorted(hashes[0].keys() | hashes[1].keys()):
        if hashes[0].get((role, path)) != hashes[1].get((role, path)):
            return f"{role} ({path})" if path else role
    return None


def _place(one: Input) -> tuple[str, str]:
    return one.role, "" if one.role == CASE_ROLE else posixpath.normpath(one.path)


def content_input(role: str, name: str, content: bytes) -> Input:
    """The input of a role and path, with the hash of these bytes."""
    return Input(role, name, hashlib.sha256(content).hexdigest())


class InputFiles:
    """The files of one folder that a result is made from: each is read once, and hashed as it was read."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._inputs: dict[tuple[str, str], Input] = {}
        self._held: dict[str, bytes] = {}
        self._known: dict[str, str] = {}

    def again(self) -> InputFiles:
        """A copy that reads the same files for another result: those that have changed since are refused."""
        files = InputFiles(self._folder)
        files._held, files._known = dict(self._held), {one.path: one.sha256 for one in self.inputs if one.path}
        return files

    @property
    def inputs(self) -> tuple[Input, ...]:
        """Every file in each of its roles, in the order of reading."""
        return tuple(self._inputs.values())

    def add(self, role: str, name: str, content: bytes) -> bytes:
        """List bytes that were read already, and keep them. Raises InputError: not those that were read `again`."""
        one = self._inputs[role, name] = content_input(role, name, content)
        if self._known.get(name, one.sha256) != one.sha256:
            self._refuse_changed(name)
        self._held[name] = content
        return content

    def take(self, other: InputFiles, *, but: Sequence[str]) -> None:
        """List the inputs of another result without reading them again, but for some roles."""
        self._inputs |= {key: one for key, one in other._inputs.items() if key[0] not in (CASE_ROLE, *but)}

    def state(self, role: str, content: bytes) -> None:
        """List bytes as an input that comes from no file."""
        self._inputs[role, ""] = content_input(role, "", content)

    def read(self, role: str, name: str, *, max_bytes: int, key: str, where: Path) -> bytes:
        """The content of a file, by its ``name`` in the ``key`` of ``where``; read where no role has wanted it before.

        Raises InputError: it is missing, no plain file, empty, too large or not readable.
        """
        content = self._held.get(name)
        if content is None:
            file = self._folder / name
            if not is_plain_file(file):
                what = f"{key}: file '{name[:200]}' {absence(file)}"
                refuse(what, where, f"a file in {self._folder}", "no_such_file")
            content = read_input(file, max_bytes=max_bytes, where=str(self._folder / name))
        return self.add(role, name, content)

    def held(self, name: str) -> bytes | None:
        """The bytes of a file that are still in memory."""
        return self._held.get(name)

    def content(self, name: str) -> bytes:
        """The bytes of a file that was read; what was let go of is read again. Raises InputError: it has changed."""
        held = self._held.get(name)  # looked at once: another thread may let go of it
        if held is not None:
            return held
        known = self.sha256(name)
        content = read_input(self._folder / name, max_bytes=1 << 40, where=str(self._folder / name))
        if content_input("", name, content).sha256 != known:
            self._refuse_changed(name)
        return content

    def _refuse_changed(self, name: str) -> NoReturn:
        refuse("has changed since it was read", self._folder / name, "start again", "input_changed")

    def sha256(self, name: str) -> str:
        """The hash of a file that was read."""
        return next(one.sha256 for one in self._inputs.values() if one.path == name)

    def release(self) -> None:
        """Release the bytes of all but the smallest files; every hash stays."""
        small, total = {}, 0
        for name, content in sorted(self._held.items(), key=lambda one: len(one[1])):
            total += len(content)
            if total <= KEPT_BYTES:
                small[name] = content
        self._held = small

    def __getstate__(self) -> dict[str, Any]:
        """For pickling: the state without bytes; another process reads what it needs, checked by its hash."""
        return {**self.__dict__, "_held": {}}
