"""Progress on stderr: what is being done, how fast, and when it ends."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn


class ProgressDisplay:
    """A `planning.prepared.Watcher` that draws bars on stderr, with rate and remaining time."""

    def __init__(self) -> None:
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:.0f}/{task.total}"),
            TextColumn("{task.fields[rate]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
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
        task = self._task(stage, None)
        self._bars.update(task, advance=1, description=f"{stage}: {what}")

    def count(self, stage: str, done: int, total: int) -> None:
        """Show how far a stage is."""
        task = self._task(stage, total)
        speed = self._bars.tasks[task].speed
        self._bars.update(task, completed=done, total=total, rate="" if speed is None else f"{speed:,.0f}/s")

    def _task(self, stage: str, total: int | None) -> TaskID:
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total, rate="")
        return self._tasks[stage]
