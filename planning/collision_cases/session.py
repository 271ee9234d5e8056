"""One run of pytest: cases that were read, their searches, differences found, and numbers to be rewritten.

A green run must not be read as if arms had been checked where they were not: `arm_notes` says so at its end.
`rewrite` puts new numbers into a file that people wrote; its comments, order and spaces stay.
Nothing heavy is imported here, since every run of pytest loads it.
"""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from decimal import ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from puncture_twin.planning.base.errors import InputError, one_line, refuse
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.text import plural

if TYPE_CHECKING:
    from puncture_twin.planning.search.candidates import Candidates
    from puncture_twin.planning.search.context import CaseContext


@dataclass
class Session:
    """Cases and searches of one run, read once: meshes and trees cost more than any check.

    ``changes`` has each file, what it held when it was read, and the numbers that changed.
    """

    changes: dict[Path, tuple[bytes, list[Change]]] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    _contexts: dict[tuple[Path, bool], CaseContext] = field(default_factory=dict)
    _searches: dict[tuple[Path, bool], Candidates] = field(default_factory=dict)

    def context(self, path: Path, *, arm: bool) -> CaseContext:
        """The prepared context of a case."""
        from puncture_twin.planning.search.context import prepare  # here: every run of pytest loads this module

        key = (path.resolve(), arm)
        if key not in self._contexts:
            self._contexts[key] = prepare(path, arm=arm)
        return self._contexts[key]

    def search(self, path: Path, *, arm: bool) -> Candidates:
        """The search of a case's whole grid."""
        key = (path.resolve(), arm)
        if key not in self._searches:
            self._searches[key] = self.context(path, arm=arm).search()
        return self._searches[key]

    def change(self, path: Path, data: bytes, change: Change) -> None:
        """Keep a number that is to be rewritten when all tests have run."""
        self.changes.setdefault(path, (data, []))[1].append(change)


SESSION = pytest.StashKey[Session]()


def session_of(config: pytest.Config) -> Session:
    """The session of this run of pytest."""
    return config.stash.setdefault(SESSION, Session())


def write_changes(config: pytest.Config) -> bool:
    """Rewrite every file whose numbers changed; whether all could be."""
    session, whole = session_of(config), True
    for path, (data, changes) in session.changes.items():
        try:
            session.lines += rewrite(path, data, changes)
        except InputError as error:
            session.lines.append(f"not rewritten: {error}")
            whole = False
    return whole


ARM_PROPERTY = "arm"
"""Name of a property of a test's report: it comes back from other processes too, and into JUnit's file."""
CHECKED = "checked"
UPDATE = "--collision-update"
SEVERAL = f"{UPDATE} rewrites files: run it in one process, without -n"


def arm_notes(reports: Iterable[object]) -> list[str]:
    """A line for each case and reason for which an arm was not checked in a test's call; none where it always was."""
    notes: Counter[str] = Counter()
    for report in reports:
        if getattr(report, "when", "") == "call":
            properties = dict(getattr(report, "user_properties", ()))
            if properties.get(ARM_PROPERTY, CHECKED) != CHECKED:
                notes[f"{properties['case']}: arm {properties[ARM_PROPERTY]}"] += 1
    return [f"{line} ({plural(count, 'test')})" for line, count in notes.items()]


def updating(config: pytest.Config) -> bool:
    """Whether numbers are to be rewritten; several processes at once may not."""
    wanted = bool(config.getoption(UPDATE))
    if wanted and config.getoption("numprocesses", None):
        raise pytest.UsageError(SEVERAL)
    return wanted


@dataclass(frozen=True)
class Change:
    """A number to be rewritten, of a table by its array, such as ``check``, and its place there, from 0 on."""

    kind: str
    at: int
    test: str
    number: NewNumber


def rewrite(path: Path, data: bytes, changes: Sequence[Change]) -> list[str]:
    """Rewrite a file, whole or not at all; one line a number: where, old and new.

    Raises InputError: it is another one by now, or cannot be written.
    """
    path = path.resolve()
    if path.read_bytes() != data:
        refuse("changed while the tests ran", path, "an unchanged file: run again", "input_changed")
    text, lines = _rewritten(data.decode("utf-8"), path, changes)
    with atomic(path) as draft:
        draft.write_bytes(text.encode("utf-8"))
    return lines


def _rewritten(text: str, path: Path, changes: Sequence[Change]) -> tuple[str, list[str]]:
    import tomlkit  # here: few runs rewrite

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
        refuse("cannot be rewritten without changing other text", path, "change the numbers by hand", "not_rewritable")
    return written, lines


def _at(document: Any, keys: Sequence[str | int]) -> Any:
    for key in keys:
        document = document[key]
    return document


MOST_DECIMALS = 17
"""Decimals of a written number: more than a double has."""
MOST_LINES, MOST_DIFFERENCES, MOST_CHARACTERS = 15, 6, 300
"""Of a failure: more is not read. Of its lines that say what differs; and of a line."""


@dataclass(frozen=True)
class NewNumber:
    """The found number of a key that expects another, and by how much the written one may differ.

    It is rounded so that what is written is satisfied: `ROUND_FLOOR` for a least value, `ROUND_CEILING` for a largest.
    """

    keys: tuple[str, ...]
    value: float
    within: float
    rounding: str = ROUND_HALF_EVEN

    @property
    def is_limit(self) -> bool:
        """Whether it is a bound that a person demands, which a rewrite makes weaker."""
        return self.rounding in {ROUND_FLOOR, ROUND_CEILING}

    def written(self, old: str) -> str:
        """The number as text, with the old text's decimals, or with as many as it needs."""
        exact = Decimal(repr(self.value))
        for decimals in range(len(old.partition(".")[2]) if "e" not in old.lower() else 0, MOST_DECIMALS):
            rounded = exact.quantize(Decimal(1).scaleb(-decimals), rounding=self.rounding)
            if abs(rounded - exact) <= Decimal(repr(self.within)):
                return f"{rounded:f}"
        return repr(self.value)


@dataclass(frozen=True)
class Difference:
    """One difference, and what the file would have to expect; None where only a person may change it."""

    line: str
    number: NewNumber | None = None


@dataclass(frozen=True)
class Finding:
    """Result of one test: its differences, lines for a person, the most telling first, and how to see all of it."""

    differences: tuple[Difference, ...] = ()
    detail: tuple[str, ...] = ()
    last: str = ""

    def text(self, why: str) -> str:
        """Differences, why other values were expected, and what was found, in `MOST_LINES` lines."""
        lines = [difference.line for difference in self.differences]
        if len(lines) > MOST_DIFFERENCES:
            lines[MOST_DIFFERENCES - 1 :] = [f"and {len(lines) - MOST_DIFFERENCES + 1} more that differ"]
        lines += [f"why: {why}"] if why.strip() else []
        last = [self.last] if self.last else []
        lines += [*self.detail[: MOST_LINES - len(lines) - len(last)], *last]
        return "\n".join(line if len(line) <= MOST_CHARACTERS else one_line(line, MOST_CHARACTERS) for line in lines)
