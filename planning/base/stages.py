"""How long each stage of a run took."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


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
