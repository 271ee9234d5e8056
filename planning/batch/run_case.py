"""One case as a pure function, its files in, its result's folder out; and the worker that runs one after the other."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import threading
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NamedTuple

from puncture_twin.planning.base.cache.array_cache import MEMORY_BYTES, NO_MEMORY, Memory
from puncture_twin.planning.base.errors import InputError, one_line
from puncture_twin.planning.base.output.output_set import disk_is_full
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

READY = "ready"
"""A worker's first message: its modules are loaded."""


@dataclass(frozen=True)
class CaseTask:
    """One case to be run, with all that a worker needs.

    Attributes:
        work: For what is being written, on the same file system.
        write_page: Writes the case's page too, or None.
        attempt: 1, or 2 after a worker has died of it.
    """

    planned: PlannedCase
    out: Path
    work: Path
    write_page: WritePage | None = None
    attempt: int = 1


class CaseEnd(NamedTuple):
    """How a case ended.

    Attributes:
        exit_code: Of its row; None where there is no row.
        reason: Of its row; or why there is none: its files are not those of the plan.
        full: What the system said of a disk that takes no more, or "".
    """

    id: str
    exit_code: int | None
    reason: str | None
    full: str = ""


STALE = "its files differ from those of the plan"


def run_case(task: CaseTask, memory: Memory = NO_MEMORY) -> CaseEnd:
    """Search a case and commit its result; nothing is done where there is a final one.

    Args:
        memory: What this process keeps from one case to the next.
    """
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


def commit_failure(task: CaseTask, reason: str) -> CaseEnd:
    """Commit the row of a case that no worker survived, or that ran into a limit."""
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


def run_here(tasks: Sequence[CaseTask], limits: object) -> Generator[CaseEnd, None, None]:
    """Run cases in this process, which no limit holds for; yields how each ended."""
    del limits
    memory = Memory(MEMORY_BYTES)
    for task in tasks:
        yield run_case(task, memory)


def work(connection: Connection, memory_bytes: int) -> None:
    """Run tasks from the queue until none is left.

    Args:
        connection: Gives `CaseTask`, takes `READY` and then a `CaseEnd` for each.
        memory_bytes: What is kept from one case to the next.
    """
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    memory = Memory(memory_bytes)
    connection.send(READY)
    while True:
        try:
            task: CaseTask = connection.recv()
        except EOFError:
            return
        connection.send(run_case(task, memory))


def _leave_with_parent() -> None:
    """A worker without its main process would write on while the next run begins."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
