"""Progress on stderr: what is done, how fast, and when it ends. Bars on a terminal, now and then a line in a log."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Self, TextIO

if TYPE_CHECKING:
    from rich.progress import TaskID

LINE_EVERY_S = 5.0  # in a log one line in this time says enough
LONG_S = 3.0  # what took so long is told when it is done
LEAST_TIME_S = 0.5  # of a rate: with less behind it, it says nothing
USUALLY_S = {"map": 1.0, "scene": 1.0, "slices": 1.0, "page": 1.0, "rehearsal": 2.0, "film": 3.0}
"""Stages that take about as long for every case, on two cores; others count, or depend on what there is to read."""


def progress_display(stream: TextIO | None = None) -> BarDisplay | LineDisplay:
    """Bars where a person watches, lines where a file does."""
    stream = stream or sys.stderr
    return BarDisplay(stream) if stream.isatty() else LineDisplay(stream)


class LineDisplay:
    """A `puncture_twin.planning.base.progress.Watcher` that writes a line every few seconds."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._pace = Pace()
        self._last = self._since = time.monotonic()
        self._at = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        return None

    def step(self, stage: str, what: str) -> None:
        """Name the item of a stage; and the one before, and its time, where that was long."""
        took_s = time.monotonic() - self._since
        if self._at and took_s >= LONG_S:
            self.note(f"{self._at}, took {duration_text(took_s)}")
        self._at, self._since = f"{stage}: {what}", time.monotonic()
        self._write(f"{stage}: {step_text(what)}")

    def count(self, stage: str, done: int, total: int, failed: int = 0) -> None:
        """Write how far a stage is, its rate and its remaining time, as soon as there is time behind a rate."""
        self._write(f"{stage}: {self._pace.text(stage, done, total, failed)}")

    def note(self, line: str) -> None:
        """Write a line now: a note is shown once."""
        self._stream.write(line + "\n")
        self._stream.flush()

    def _write(self, line: str) -> None:
        if time.monotonic() - self._last >= LINE_EVERY_S:
            self._last = time.monotonic()
            self.note(line)


class BarDisplay:
    """A `puncture_twin.planning.base.progress.Watcher` that draws bars with rate and remaining time."""

    def __init__(self, stream: TextIO) -> None:
        from rich.console import Console  # here: a log does not wait for it
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[far]}"), TimeElapsedColumn())
        self._bars = Progress(*columns, console=Console(file=stream), transient=True)
        self._tasks: dict[str, TaskID] = {}
        self._pace = Pace()

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bars.stop()

    def step(self, stage: str, what: str) -> None:
        """Name the item of a stage."""
        self._bars.update(self._task(stage, None), advance=1, description=f"{stage}: {step_text(what)}")

    def count(self, stage: str, done: int, total: int, failed: int = 0) -> None:
        """Show how far a stage is."""
        far = self._pace.text(stage, done, total, failed)
        self._bars.update(self._task(stage, total), completed=done, total=total, far=far)

    def note(self, line: str) -> None:
        """Write a line above the bars."""
        self._bars.console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _task(self, stage: str, total: int | None) -> TaskID:
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total, far="")
        return self._tasks[stage]


def rate_text(per_second: float) -> str:
    """A rate in the unit in which it is at least 1, if any is."""
    for seconds, unit in ((1.0, "s"), (60.0, "min")):
        if per_second * seconds >= 1.0:
            return f"{per_second * seconds:,.0f}/{unit}"
    return f"{per_second * 3600.0:,.1f}/h"


def duration_text(seconds: float) -> str:
    """Text of a duration, in the unit that a person would choose."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


class Pace:
    """Speed of a stage since its first count, or since it began anew."""

    def __init__(self) -> None:
        self._since: dict[str, tuple[float, int, int]] = {}
        self._last: dict[str, int] = {}

    def text(self, stage: str, done: int, total: int, failed: int) -> str:
        """Text of how many are done of how many, and how many failed; rate and time left, with time behind them."""
        began, first, of = self._since.get(stage, (0.0, 0, -1))
        if of != total or done < self._last[stage]:
            began, first = time.monotonic(), done
            self._since[stage] = began, first, total
        self._last[stage] = done
        failures, rate, seconds = f", {failed} failed" if failed else "", "", time.monotonic() - began
        if done > first and seconds >= LEAST_TIME_S:
            per_second = (done - first) / seconds
            rate = f", {rate_text(per_second)}, {duration_text((total - done) / per_second)} left"
        return f"{done:,}/{total:,}{failures}{rate}"


def step_text(what: str) -> str:
    """A thing that a stage has come to, with what it usually takes where no count tells how far it is."""
    return f"{what}, usually {duration_text(USUALLY_S[what])}" if what in USUALLY_S else what
