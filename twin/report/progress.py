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


class LineDisplay:
    """A `puncture_twin.planning.base.progress.Watcher` that writes a line every few seconds."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._started: dict[str, float] = {}
        self._last = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def step(self, stage: str, what: str) -> None:
        """Name what a stage is at."""
        self._say(f"{stage}: {what}")

    def count(self, stage: str, done: int, total: int) -> None:
        """Say how far a stage is, its rate, and how long it still takes."""
        started = self._started.setdefault(stage, time.monotonic())
        rate = done / max(time.monotonic() - started, 1e-9)
        self._say(f"{stage}: {done}/{total}, {rate:,.0f}/s, {(total - done) / rate:.0f} s left")

    def note(self, line: str) -> None:
        """Write a line now: it is said once."""
        self._stream.write(line + "\n")
        self._stream.flush()

    def _say(self, line: str) -> None:
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

    def count(self, stage: str, done: int, total: int) -> None:
        """Show how far a stage is."""
        task = self._task(stage, total)
        speed = self._bars.tasks[task].speed
        self._bars.update(task, completed=done, total=total, rate="" if speed is None else f"{speed:,.0f}/s")

    def note(self, line: str) -> None:
        """Write a line above the bars."""
        self._bars.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _task(self, stage: str, total: int | None) -> TaskID:
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total, rate="")
        return self._tasks[stage]
