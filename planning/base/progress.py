"""Whoever shows how far a piece of work is. The planner tells; it never prints."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

Count = Callable[[int, int], None]
"""Called with (done, to do), as often as something is done."""


def uncounted(done: int, total: int) -> None:
    """A `Count` that tells nobody."""


class Watcher(Protocol):
    """Whoever shows progress."""

    def step(self, stage: str, what: str) -> None:
        """A stage has come to a named thing."""
        ...

    def count(self, stage: str, done: int, total: int) -> None:
        """A stage has done so many of so many."""
        ...

    def note(self, line: str) -> None:
        """Something happened that whoever watches should know."""
        ...


class Silent:
    """Shows nothing."""

    def step(self, stage: str, what: str) -> None:
        """Nothing."""

    def count(self, stage: str, done: int, total: int) -> None:
        """Nothing."""

    def note(self, line: str) -> None:
        """Nothing."""
