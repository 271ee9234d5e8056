"""Progress on stderr: what is done, how fast, and when it ends. Bars on a terminal, now and then a line in a log."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

LINE_EVERY_S = 5.0
"""In a log one line in this time says enough."""


def progress_display(stream: TextIO | None = None) -> BarDisplay | LineDisplay:
    """Bars where a person watches, lines where a file does."""
    stream = stream or sys.stderr
    return BarDisplay(stream) if stream.isatty() else LineDisplay(stream)


LEAST_TIME_S = 0.5
"""Of a rate: with less behind it, it says nothing."""


def rate_text(per_second: float) -> str:
    """A rate in the unit in which it is at least 1, if any is."""
    for seconds, unit in ((1.0, "s"), (60.0, "min")):
        if per_second * seconds >= 1.0:
            return f"{per_second * seconds:,.0f}/{unit}"
    return f"{per_second * 3600.0:,.1f}/h"


def duration_text(seconds: float) -> str:
    """How long something takes, in the unit that a person would choose."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


def _rate_text(done: int, seconds: float, left: int) -> str:
    if done <= 0 or seconds < LEAST_TIME_S:
        return ""
    return f", {rate_text(done / seconds)}, {duration_text(left * seconds / done)} left"


def _failed_text(failed: int) -> str:
    return f", {failed} failed" if failed else ""


class LineDisplay:
    """A `puncture_twin.planning.base.progress.Watcher` that writes a line every few seconds."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._started: dict[str, tuple[float, int]] = {}
        self._last = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def step(self, stage: str, what: str) -> None:
        """Name what a stage is at."""
        self._write(f"{stage}: {what}")

    def count(self, stage: str, done: int, total: int, failed: int = 0) -> None:
        """Say how far a stage is, its rate, and how long it still takes, as soon as there is time behind a rate."""
        since = self._started.setdefault(stage, (time.monotonic(), done))
        spent, more = time.monotonic() - since[0], done - since[1]
        self._write(f"{stage}: {done}/{total}{_failed_text(failed)}{_rate_text(more, spent, total - done)}")

    def note(self, line: str) -> None:
        """Write a line now: it is said once."""
        self._stream.write(line + "\n")
        self._stream.flush()

    def _write(self, line: str) -> None:
        if time.monotonic() - self._last >= LINE_EVERY_S:
            self._last = time.monotonic()
            self._stream.write(line + "\n")
            self._stream.flush()


class BarDisplay:
    """A `puncture_twin.planning.base.progress.Watcher` that draws bars with rate and remaining time."""

    def __init__(self, stream: TextIO) -> None:
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            console=Console(file=stream),
            transient=True,
        )
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def step(self, stage: str, what: str) -> None:
        """Name what a stage is at."""
        self._bars.update(self._task(stage, None), advance=1, description=f"{stage}: {what}")

    def count(self, stage: str, done: int, total: int, failed: int = 0) -> None:
        """Show how far a stage is."""
        task = self._task(stage, total)
        speed = self._bars.tasks[task].speed
        rate = ("" if speed is None else rate_text(speed)) + _failed_text(failed)
        self._bars.update(task, completed=done, total=total, rate=rate)

    def note(self, line: str) -> None:
        """Write a line above the bars."""
        self._bars.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _task(self, stage: str, total: int | None) -> TaskID:
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total, rate="")
        return self._tasks[stage]
