"""A cohort's cases, or a part, run by one at a time until each has a row; what has one is left as it is."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.output.output_set import disk_is_full
from puncture_twin.planning.base.processes import worker_count
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.batch.part import WHOLE, Part
from puncture_twin.planning.batch.plan import PlannedCase, read_plan_table
from puncture_twin.planning.batch.result import WORK_PREFIX, discard, is_final, read_row
from puncture_twin.planning.batch.run_case import CaseEnd, CaseTask, WritePage
from puncture_twin.planning.batch.workers import NO_LIMITS, Limits, run_tasks

RunTasks = Callable[[Sequence[CaseTask], Limits], Generator[CaseEnd, None, None]]
"""Runs cases somewhere, and yields how each ended."""

LOCK_NAME = ".puncture-twin-run-lock"
ALLOWED = "one run at a time, parts beside each other (--part i/n), or another folder"


@dataclass(frozen=True)
class Request:
    """What is to be run, and how.

    Attributes:
        part: Of the plan.
        jobs: Processes of this machine, at most one a core.
        limits: Of each case.
        write_page: Writes a page for each case that is searched, or None.
    """

    part: Part = WHOLE
    jobs: int = 1
    limits: Limits = NO_LIMITS
    write_page: WritePage | None = None


@dataclass
class RunCounts:
    """What a run did.

    Attributes:
        planned: Cases of the part.
        same: Of them the same as others, to the byte: they are run once.
        before: Others that had their rows.
        refused_before: Of these, cases whose inputs were refused.
        ended: Exit code of a row to how many rows.
        reasons: Of rows whose exit code is above 1.
        stale: Cases whose files are not those of the plan; they have no row.
    """

    planned: int
    same: int
    before: int
    refused_before: int = 0
    ended: Counter[int] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    stale: int = 0

    @property
    def failed(self) -> int:
        """Cases that this run has left without a verdict so far."""
        return self.stale + sum(count for code, count in self.ended.items() if code > 1)

    @property
    def whole(self) -> bool:
        """Whether every case of the part has a verdict, whichever run gave it."""
        return not (self.failed or self.refused_before)

    def add(self, end: CaseEnd) -> None:
        """Count one more."""
        if end.exit_code is None:
            self.stale += 1
            return
        self.ended[end.exit_code] += 1
        if end.exit_code > 1:
            self.reasons[end.reason or ""] += 1


def run_cohort(out: Path, request: Request, watcher: Watcher, elsewhere: RunTasks | None = None) -> RunCounts:
    """Run what has no final row yet.

    Args:
        out: The cohort's folder, with its plan.
        request: Which part, and how.
        watcher: Whoever shows progress, in cases.
        elsewhere: Runs the cases; None runs them in processes of this machine.

    Raises:
        InputError: No plan, one of another version, another run in the folder, or a disk that takes no more.
    """
    plan = read_plan_table(out)
    if plan.version != version("puncture-twin"):
        what = f"the plan is of version {plan.version}, this is {version('puncture-twin')}"
        raise InputError(what, where=out, allowed="batch plan again: what is unchanged since is not lost")
    with running(out, request.part) as work:
        rows = request.part.of(plan.cases)
        cases = distinct(rows)
        kept = [_kept_row(one, out, work) for one in cases]
        tasks = [CaseTask(one, out, work, request.write_page) for one, row in zip(cases, kept, strict=True) if not row]
        refused = sum(row["exit_code"] > 1 for row in kept if row)
        counts = RunCounts(len(rows), len(rows) - len(cases), len(cases) - len(tasks), refused)
        watcher.count("cases", 0, len(tasks))
        with closing(_ends(tasks, request, elsewhere)) as ends:
            for done, end in enumerate(ends, start=1):
                if end.full:
                    what = f"cannot be written ({end.full}); the cases that are done stay"
                    raise InputError(what, where=out, allowed="a folder with enough free space")
                counts.add(end)
                watcher.count("cases", done, len(tasks), counts.failed)
    return counts


def distinct(cases: Iterable[PlannedCase]) -> list[PlannedCase]:
    """The first case of each id: of the same bytes, options and version the answer is one."""
    return list({one.id: one for one in reversed(list(cases))}.values())[::-1]


def _ends(tasks: Sequence[CaseTask], request: Request, elsewhere: RunTasks | None) -> Generator[CaseEnd, None, None]:
    if elsewhere is not None:
        return elsewhere(tasks, request.limits)
    return run_tasks(tasks, worker_count(request.jobs, len(tasks)), request.limits)


def _kept_row(planned: PlannedCase, out: Path, work: Path) -> dict[str, Any] | None:
    """The row of a case; what is there otherwise, a failure of the program or half a result, goes."""
    row = read_row(out, planned.id)
    if is_final(row):
        return row
    discard(out, planned.id, work)
    return None


@contextmanager
def running(out: Path, part: Part) -> Iterator[Path]:
    """Hold a part of a cohort; yields a folder for what is being written, which goes in the end.

    The system frees the locks of a process that dies, and its folder is removed by the next run of the same part, or of
    the whole.

    Raises:
        InputError: Another process runs it, or the folder cannot be written to.
    """
    work = out / f"{WORK_PREFIX}{part.number}-of-{part.parts}"
    with ExitStack() as stack:
        try:
            stack.enter_context(_locked(out, LOCK_NAME, fcntl.LOCK_EX if part == WHOLE else fcntl.LOCK_SH))
            if part != WHOLE:
                stack.enter_context(_locked(out, f"{LOCK_NAME}-{part.number}-of-{part.parts}", fcntl.LOCK_EX))
            for left in out.glob(f"{WORK_PREFIX}*") if part == WHOLE else [work]:
                shutil.rmtree(left, ignore_errors=True)
            work.mkdir(exist_ok=True)
        except OSError as error:
            full = disk_is_full(error, out)
            allowed = "a folder with enough free space" if full else "a folder that may be written to"
            raise InputError(f"cannot be written ({error.strerror})", where=out, allowed=allowed) from error
        stack.callback(shutil.rmtree, work, ignore_errors=True)
        yield work


@contextmanager
def _locked(out: Path, name: str, kind: int) -> Iterator[None]:
    handle = os.open(out / name, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(handle, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise InputError("another run is at work in this folder", where=out, allowed=ALLOWED) from None
    try:
        yield
    finally:
        os.close(handle)
