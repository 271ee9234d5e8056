"""Progress as bars on a terminal, drawn by rich."""

from __future__ import annotations

from types import TracebackType
from typing import Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from puncture_twin.twin.report.pace import Pace, step_text


class BarDisplay:
    """A `puncture_twin.planning.base.progress.Watcher` that draws bars with rate and remaining time."""

    def __init__(self, stream: TextIO) -> None:
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[far]}"),
            TimeElapsedColumn(),
            console=Console(file=stream),
            transient=True,
        )
        self._tasks: dict[str, TaskID] = {}
        self._pace = Pace()

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def step(self, stage: str, what: str) -> None:
        """Name what a stage is at."""
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
