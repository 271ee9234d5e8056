"""How far a piece of work is, told to whoever shows it, and how long its stages took. The planner never prints."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

Count = Callable[[int, int], None]
"""Called with (done, to do), as often as something is done."""


Names = Callable[[str], None]
"""Called with the name of each thing as it is come to."""


def unnamed(name: str) -> None:
    """A `Names` that tells nobody."""


def uncounted(done: int, total: int) -> None:
    """A `Count` that tells nobody."""


class Watcher(Protocol):
    """Whoever shows progress."""

    def step(self, stage: str, what: str) -> None:
        """A stage has come to a named thing."""
        ...

    def count(self, stage: str, done: int, total: int, failed: int = 0) -> None:
        """A stage has done so many of so many, and so many of these have failed."""
        ...

    def note(self, line: str) -> None:
        """Something happened that whoever watches should know."""
        ...


class Silent:
    """Shows nothing."""

    def step(self, stage: str, what: str) -> None:
        """Nothing."""

    def count(self, stage: str, done: int, total: int, failed: int = 0) -> None:
        """Nothing."""

    def note(self, line: str) -> None:
        """Nothing."""


@dataclass
class Stages:
    """A stopwatch with names; seconds, in the order in which the stages ended.

    Attributes:
        seconds: That each stage has taken so far.
        announce: Called with a stage's name when it begins, for whoever shows progress.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    announce: Callable[[str], None] | None = None

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        """Add the time that the block takes to the stage of this name."""
        if self.announce is not None:
            self.announce(name)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
