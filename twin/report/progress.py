"""Progress on stderr: what is done, how fast, and when it ends. Bars on a terminal, now and then a line in a log."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING, Self, TextIO

from puncture_twin.twin.report.pace import Pace, duration_text, step_text

if TYPE_CHECKING:
    from puncture_twin.twin.report.progress_bars import BarDisplay

LINE_EVERY_S = 5.0
"""In a log one line in this time says enough."""
LONG_S = 3.0
"""What took so long is told when it is done."""


def progress_display(stream: TextIO | None = None) -> BarDisplay | LineDisplay:
    """Bars where a person watches, lines where a file does."""
    stream = stream or sys.stderr
    if not stream.isatty():
        return LineDisplay(stream)
    from puncture_twin.twin.report.progress_bars import BarDisplay  # here: a log does not wait for its library

    return BarDisplay(stream)


class LineDisplay:
    """A `puncture_twin.planning.base.progress.Watcher` that writes a line every few seconds."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._pace = Pace()
        self._last = self._since = time.monotonic()
        self._at = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def step(self, stage: str, what: str) -> None:
        """Name what a stage is at; and what it was at, and for how long, where that was long."""
        took_s = time.monotonic() - self._since
        if self._at and took_s >= LONG_S:
            self.note(f"{self._at}, took {duration_text(took_s)}")
        self._at, self._since = f"{stage}: {what}", time.monotonic()
        self._write(f"{stage}: {step_text(what)}")

    def count(self, stage: str, done: int, total: int, failed: int = 0) -> None:
        """Say how far a stage is, its rate, and how long it still takes, as soon as there is time behind a rate."""
        self._write(f"{stage}: {self._pace.text(stage, done, total, failed)}")

    def note(self, line: str) -> None:
        """Write a line now: it is said once."""
        self._stream.write(line + "\n")
        self._stream.flush()

    def _write(self, line: str) -> None:
        if time.monotonic() - self._last >= LINE_EVERY_S:
            self._last = time.monotonic()
            self._stream.write(line + "\n")
            self._stream.flush()
