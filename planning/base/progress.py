"""How far a piece of work is, told to whoever shows it, and how long its stages took. The planner never prints.

Who embeds it hears of stages (INFO), of what each is at (DEBUG) and of a case's warnings by the logger `LOG`.
"""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

LOG = logging.getLogger("puncture_twin")
LOG.addHandler(logging.NullHandler())  # nothing is printed unless a program says where

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

    def count(self, stage: str, done: int, total: int, failed: int = 0) -> None:
        """A stage has done so many of so many, and so many of these have failed."""

    def note(self, line: str) -> None:
        """Something happened that whoever watches should know."""


class Silent:
    """Shows nothing, and logs what happens."""

    def step(self, stage: str, what: str) -> None:
        """Log it for who looks closely."""
        LOG.debug("%s: %s", stage, what)

    def count(self, stage: str, done: int, total: int, failed: int = 0) -> None:
        """Nothing: it may be called a thousand times."""

    def note(self, line: str) -> None:
        """Log it."""
        LOG.info(line)


@dataclass
class Stages:
    """A stopwatch with names; seconds, in the order in which the stages ended."""

    seconds: dict[str, float] = field(default_factory=dict)
    # called with a stage's name when it begins, for whoever shows progress
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
            took = time.perf_counter() - start
            self.seconds[name] = self.seconds.get(name, 0.0) + took
            LOG.info("%s: %.3f s", name, took)
