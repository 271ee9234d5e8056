"""Progress of work, reported to whoever shows it, and the time of its stages. The planner never prints.

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
"""Callback with (done, to do), called as often as something is done."""
Names = Callable[[str], None]
"""Callback with the name of each item when it begins."""


def unnamed(name: str) -> None:
    """A `Names` that does nothing."""


def uncounted(done: int, total: int) -> None:
    """A `Count` that does nothing."""


class Watcher(Protocol):
    """Interface of whatever shows progress."""

    def step(self, stage: str, what: str) -> None:
        """Report that a stage has reached a named item."""

    def count(self, stage: str, done: int, total: int, failed: int = 0) -> None:
        """Report how many items of a stage are done, of how many, and how many failed."""

    def note(self, line: str) -> None:
        """Report an event that a person should know of."""


class Silent:
    """A watcher that shows nothing and logs what happens."""

    def step(self, stage: str, what: str) -> None:
        """Log the step at the level of details."""
        LOG.debug("%s: %s", stage, what)

    def count(self, stage: str, done: int, total: int, failed: int = 0) -> None:
        """Ignore the count: it may be reported a thousand times."""

    def note(self, line: str) -> None:
        """Log the event."""
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
