"""One case as a pure function, its files in, its result's folder out; and the processes that run many.

A worker that dies costs the case that it was at one of two tries, and nothing else.
"""

from __future__ import annotations

import json
import shutil
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from puncture_twin.planning.base.cache.array_cache import MEMORY_BYTES, NO_MEMORY, Memory
from puncture_twin.planning.base.errors import InputError, one_line
from puncture_twin.planning.base.output.output_set import disk_is_full
from puncture_twin.planning.base.processes import process_pool
from puncture_twin.planning.base.progress import Stages
from puncture_twin.planning.base.provenance import Input, inputs_document, read_inputs
from puncture_twin.planning.batch.merge import blank_row, searched_row
from puncture_twin.planning.batch.plan import (
    PAGE_NAME,
    PROGRAM_FAILED,
    TABLE_NAME,
    PlannedCase,
    case_id,
    commit,
    identified,
    new_draft,
    read_row,
    relative_text,
    write_row,
)
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.case.options import case_options
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import CaseContext, prepare
from puncture_twin.planning.search.table import write_table

WritePage = Callable[[CaseContext, Candidates, Path], None]
"""Writes a case's page into a folder."""

BAD_INPUT = 2


@dataclass(frozen=True)
class CaseTask:
    """One case to be run, with all that a worker needs."""

    planned: PlannedCase
    out: Path
    work: Path
    write_page: WritePage | None = None
    attempt: int = 1


class CaseEnd(NamedTuple):
    """How a case ended.

    Attributes:
        exit_code: Of the case's row; None where there is no row.
        reason: Of its row; or why there is none: its files are not those of the plan.
        full: What the system said of a disk that takes no more, or "".
    """

    id: str
    exit_code: int | None
    reason: str | None
    full: str = ""


STALE = "its files differ from those of the plan"


def run_case(task: CaseTask, memory: Memory = NO_MEMORY) -> CaseEnd:
    """Search a case and commit its result; nothing is done where there is a final one."""
    known = ended(task)
    if known is not None and known.exit_code != PROGRAM_FAILED:
        return known
    draft = new_draft(task.work, task.planned.id)
    try:
        return _run(task, memory, draft)
    except OSError as error:
        if not disk_is_full(error, task.out):
            raise
        return CaseEnd(task.planned.id, None, None, full=error.strerror or "no space left")
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def ended(task: CaseTask) -> CaseEnd | None:
    """The end of a case that has a row already; None without one."""
    row = read_row(task.out, task.planned.id)
    return None if row is None else CaseEnd(task.planned.id, row["exit_code"], row["reason"])


def failed(task: CaseTask, reason: str) -> CaseEnd:
    """Commit the row of a case that no worker survived, unless it had just ended."""
    end = ended(task)
    if end is not None:
        return end
    draft = new_draft(task.work, task.planned.id)
    inputs = read_inputs(json.loads(task.planned.inputs))
    return _committed(task, draft, blank_row(task.planned, PROGRAM_FAILED, reason), inputs, {})


def _run(task: CaseTask, memory: Memory, draft: Path) -> CaseEnd:
    planned, stages = task.planned, Stages()
    try:
        options = case_options(json.loads(planned.options), where=planned.case)
        context = prepare(load_case(planned.path, options), arm=planned.arm, memory=memory)
        stages = context.stages
        inputs = context.case.inputs
        if case_id(planned.options, planned.arm, inputs, "") != planned.id:
            return CaseEnd(planned.id, None, STALE)
        row = _searched(task, context, draft)
    except InputError as error:
        return _refused(task, draft, relative_text(str(error), planned))
    except Exception as error:  # whatever breaks becomes this case's row: the others go on
        if isinstance(error, OSError) and disk_is_full(error, task.out):
            raise
        message = relative_text(f"{type(error).__name__}: {error}", planned)
        row, inputs = blank_row(planned, PROGRAM_FAILED, message), read_inputs(json.loads(planned.inputs))
    return _committed(task, draft, row, inputs, stages.seconds)


def _searched(task: CaseTask, context: CaseContext, draft: Path) -> dict[str, Any]:
    candidates = context.search()
    write_table(candidates, draft / TABLE_NAME)
    row = searched_row(task.planned, context, candidates)
    if task.write_page is not None:
        task.write_page(context, candidates, draft)
        row["page"] = (draft / PAGE_NAME).is_file()
    return row


def _refused(task: CaseTask, draft: Path, reason: str) -> CaseEnd:
    """A refusal at reading is the plan's own, or the files have changed; a later one is of the plan's files."""
    now = identified(task.planned)
    if now.id != task.planned.id:
        return CaseEnd(task.planned.id, None, STALE)
    inputs = read_inputs(json.loads(now.inputs))
    return _committed(task, draft, blank_row(task.planned, BAD_INPUT, one_line(reason)), inputs, {})


def _committed(
    task: CaseTask, draft: Path, row: dict[str, Any], inputs: tuple[Input, ...], seconds: dict[str, float]
) -> CaseEnd:
    row["inputs"] = json.dumps(inputs_document(inputs))
    write_row(row, draft)
    timings = {"seconds": {name: round(spent, 3) for name, spent in seconds.items()}, "attempt": task.attempt}
    commit(draft, task.out, task.planned.id, inputs, timings)
    return CaseEnd(task.planned.id, row["exit_code"], row["reason"])


def run_here(tasks: Iterable[CaseTask]) -> Generator[CaseEnd, None, None]:
    """Run cases in this process; yields how each ended."""
    memory = Memory(MEMORY_BYTES)
    for task in tasks:
        yield run_case(task, memory)


WORKER_DIED = "worker_died"
"""The reason of a row that no worker could write."""

CHUNK = 8
"""Cases of one folder, a guess at the patient, that a worker runs one after the other, the patient in its memory."""

Chunk = list[CaseTask]


def chunks(tasks: Iterable[CaseTask]) -> Iterator[Chunk]:
    """Neighbours of one folder, at most `CHUNK` of them together."""
    for _, near in groupby(tasks, lambda task: Path(task.planned.path).parent):
        of_folder = list(near)
        for first in range(0, len(of_folder), CHUNK):
            yield of_folder[first : first + CHUNK]


def run_tasks(tasks: Iterable[CaseTask], jobs: int) -> Generator[CaseEnd, None, None]:
    """Run cases in processes of this machine; yields how each ended.

    A pool ends with the first of its workers that dies. What was at work then is tried once more, each case in a pool
    of its own, so that a second death tells whose it is; then a new pool takes the rest.
    """
    waiting = deque(chunks(tasks))
    while waiting:
        for chunk in (yield from _in_pool(waiting, jobs)):
            yield from _after_death(chunk, waiting)


def _in_pool(waiting: deque[Chunk], jobs: int) -> Generator[CaseEnd, None, list[Chunk]]:
    """Run what waits in one pool, until all is done or a worker dies; returns what was at work then."""
    at_work: dict[Future[list[CaseEnd]], Chunk] = {}
    with process_pool(jobs, len(waiting)) as pool, suppress(BrokenProcessPool):
        while waiting or at_work:
            while waiting and len(at_work) < jobs:
                at_work[pool.submit(_run_chunk, waiting[0])] = waiting[0]
                waiting.popleft()
            for done in wait(at_work, return_when=FIRST_COMPLETED).done:
                yield from done.result()
                del at_work[done]
    return list(at_work.values())


def _run_chunk(chunk: Chunk) -> list[CaseEnd]:
    return list(run_here(chunk))


def _after_death(chunk: Chunk, waiting: deque[Chunk]) -> Generator[CaseEnd, None, None]:
    """The ends of what a dead worker had done, and of the case that it was at; the cases behind that one wait again."""
    for number, task in enumerate(chunk):
        end = ended(task)
        if end is not None:
            yield end
            continue
        again = replace(task, attempt=2)
        if (yield from _in_pool(deque([[again]]), 1)):
            yield failed(again, WORKER_DIED)
        if chunk[number + 1 :]:
            waiting.appendleft(chunk[number + 1 :])
        return
