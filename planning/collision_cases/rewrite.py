"""New numbers in a file that people wrote: its comments, order and spaces stay."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.collision_cases.finding import NewNumber


@dataclass(frozen=True)
class Change:
    """A number of one table.

    Attributes:
        kind: The array of the table, such as ``check``.
        at: Its number in the array, from 0 on.
        test: Its name, for a person.
        number: What is to be written.
    """

    kind: str
    at: int
    test: str
    number: NewNumber


def rewrite(path: Path, data: bytes, changes: Sequence[Change]) -> list[str]:
    """Rewrite a file, whole or not at all.

    Args:
        path: The file.
        data: What it held when it was read.
        changes: The numbers.

    Returns:
        One line a number: where, old and new.

    Raises:
        InputError: The file is another one by now, or cannot be written.
    """
    path = path.resolve()
    if path.read_bytes() != data:
        raise InputError("changed while the tests ran", where=path, allowed="the same file; run again")
    text, lines = _rewritten(data.decode("utf-8"), path, changes)
    with atomic(path) as draft:
        draft.write_bytes(text.encode("utf-8"))
    return lines


def _rewritten(text: str, path: Path, changes: Sequence[Change]) -> tuple[str, list[str]]:
    document, expected, lines = tomlkit.parse(text), tomllib.loads(text), []
    for change in changes:
        tables: tuple[str | int, ...] = (change.kind, change.at, *change.number.keys[:-1])
        key = change.number.keys[-1]
        old = _at(document, tables)[key].as_string()
        new = change.number.written(old)
        _at(document, tables)[key] = tomlkit.value(new)
        _at(expected, tables)[key] = tomllib.loads(f"x = {new}")["x"]
        weaker = " (a weaker demand)" if change.number.is_limit else ""
        lines.append(f"{path.name}: {change.test}: {'.'.join(change.number.keys)} {old} -> {new}{weaker}")
    written = tomlkit.dumps(document)
    if tomllib.loads(written) != expected:
        raise InputError("cannot be rewritten without changing more", where=path, allowed="the numbers by hand")
    return written, lines


def _at(document: Any, keys: Sequence[str | int]) -> Any:
    for key in keys:
        document = document[key]
    return document
