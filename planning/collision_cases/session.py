"""What one run of pytest keeps: cases that were read, their searches, and numbers that are to be rewritten."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.collision_cases.rewrite import Change, rewrite
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import CaseContext, prepare


@dataclass
class Session:
    """Cases are read once: meshes and trees cost more than any check.

    Attributes:
        changes: File to what it held when it was read, and the numbers that changed.
        lines: What was rewritten, for a person.
    """

    changes: dict[Path, tuple[bytes, list[Change]]] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    _contexts: dict[tuple[Path, bool], CaseContext] = field(default_factory=dict)
    _searches: dict[tuple[Path, bool], Candidates] = field(default_factory=dict)

    def context(self, path: Path, *, arm: bool) -> CaseContext:
        """A case.

        Raises:
            InputError: It cannot be read, or the arm is to be checked in a case that does not say where its base is.
        """
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
    """What this run keeps."""
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


def rewritten_lines(config: pytest.Config) -> list[str]:
    """What was rewritten, one line a number."""
    return session_of(config).lines
