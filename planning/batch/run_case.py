"""One case as a pure function, its files in, its result's folder out; and the workers of this machine.

One that dies is replaced, and the case it died of is tried once more: `concurrent.futures` and joblib give up the whole
pool. The memory of a worker is watched from outside (its resident set), not limited by the system's address space:
compiled code and its threads reserve many times what they use.
"""

import json
import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, NamedTuple

from puncture_twin.planning.base.cache.array_cache import MEMORY_BYTES, NO_MEMORY, Memory
from puncture_twin.planning.base.errors import InputError, one_line, refuse
from puncture_twin.planning.base.output.output_set import disk_is_full
from puncture_twin.planning.base.progress import Stages
from puncture_twin.planning.base.provenance import Input, inputs_document, read_inputs
from puncture_twin.planning.batch import plan as plans
from puncture_twin.planning.batch.merge import blank_row, searched_row
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.case.case_file import case_options
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
    """One case to be run; drafts are written to ``work``, on the file system of ``out``; attempt 2 is after a death."""

    planned: plans.PlannedCase
    out: Path
    work: Path
    write_page: WritePage | None = None
    attempt: int = 1


class CaseEnd(NamedTuple):
    """Result of running a case."""

    id: str
    exit_code: int | None  # of the case's row; None where there is no row, and ``reason`` says why
    reason: str | None
    full: str = ""  # what the system said of a disk that takes no more, or ""


STALE = "its files differ from those of the plan"


def run_case(task: CaseTask, memory: Memory = NO_MEMORY) -> CaseEnd:
    """Search a case and commit its result; nothing is done where there is a final one."""
    known = ended(task)
    if known is not None and known.exit_code != plans.PROGRAM_FAILED:
        return known
    draft = plans.new_draft(task.work, task.planned.id)
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
    row = plans.read_row(task.out, task.planned.id)
    return None if row is None else CaseEnd(task.planned.id, row["exit_code"], row["reason"])


def failed(task: CaseTask, reason: str) -> CaseEnd:
    """Commit the row of a case that no worker survived, or that ran into a limit, unless it had just ended."""
    end = ended(task)
    if end is not None:
        return end
    draft = plans.new_draft(task.work, task.planned.id)
    inputs = read_inputs(json.loads(task.planned.inputs))
    return _committed(task, draft, blank_row(task.planned, plans.PROGRAM_FAILED, reason), inputs, {})


def _run(task: CaseTask, memory: Memory, draft: Path) -> CaseEnd:
    planned, stages = task.planned, Stages()
    try:
        options = case_options(json.loads(planned.options), where=planned.case)
        context = prepare(load_case(planned.path, options), arm=planned.arm, memory=memory)
        stages = context.stages
        inputs = context.case.inputs
        if plans.case_id(planned.options, planned.arm, inputs, "") != planned.id:
            return CaseEnd(planned.id, None, STALE)
        row = _searched(task, context, draft)
    except InputError as error:  # at reading it is the plan's own, or the files have changed; later, of its files
        reason, now = plans.relative_text(str(error), planned), plans.identified(planned)
        if now.id != planned.id:
            return CaseEnd(planned.id, None, STALE)
        row, inputs = blank_row(planned, BAD_INPUT, one_line(reason)), read_inputs(json.loads(now.inputs))
        return _committed(task, draft, row, inputs, {})
    except Exception as error:  # whatever breaks becomes this case's row: the others go on
        if isinstance(error, OSError) and disk_is_full(error, task.out):
            raise
        message = plans.relative_text(f"{type(error).__name__}: {error}", planned)
        row, inputs = blank_row(planned, plans.PROGRAM_FAILED, message), read_inputs(json.loads(planned.inputs))
    return _committed(task, draft, row, inputs, stages.seconds)


def _searched(task: CaseTask, context: CaseContext, draft: Path) -> dict[str, Any]:
    candidates = context.search()
    write_table(candidates, draft / plans.TABLE_NAME)
    row = searched_row(task.planned, context, candidates)
    if task.write_page is not None:
        task.write_page(context, candidates, draft)
        row["page"] = (draft / plans.PAGE_NAME).is_file()
    return row


def _committed(
    task: CaseTask, draft: Path, row: dict[str, Any], inputs: tuple[Input, ...], seconds: dict[str, float]
) -> CaseEnd:
    row["inputs"] = json.dumps(inputs_document(inputs))
    plans.write_row(row, draft)
    timings = {"seconds": {name: round(spent, 3) for name, spent in seconds.items()}, "attempt": task.attempt}
    plans.commit(draft, task.out, task.planned.id, inputs, timings)
    return CaseEnd(task.planned.id, row["exit_code"], row["reason"])


def run_here(tasks: Sequence[CaseTask], _limits: object) -> Generator[CaseEnd, None, None]:
    """Run cases in this process, which no limit holds for; yields how each ended."""
    memory = Memory(MEMORY_BYTES)
    for task in tasks:
        yield run_case(task, memory)


def work(connection: Connection, memory_bytes: int) -> None:
    """Run tasks from a connection, which takes `READY` and then a `CaseEnd` for each, until none is left."""
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
    """End this worker when its main process ends: it would write on while the next run begins."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


WORKER_DIED, TIMED_OUT, OUT_OF_MEMORY = "worker_died", "timed_out", "out_of_memory"
"""Reasons of the rows of cases whose worker could not write one."""
TRIES, LOOK_EVERY_S = 2, 0.2
"""Tries of a case whose worker dies; and seconds between two checks of memory and time."""
STATM = "/proc/{}/statm"
SPAWN = multiprocessing.get_context("spawn")


class Limits(NamedTuple):
    """Limits of one case, None for none: its worker's resident set, 10^6 bytes; time from when a warm worker begins."""

    memory_mb: int | None = None
    timeout_s: float | None = None


NO_LIMITS = Limits()


@dataclass
class _Worker:
    """A process and the case that it runs."""

    process: SpawnProcess
    connection: Connection
    task: CaseTask
    ready: bool = False
    since: float = field(default_factory=time.monotonic)

    def assign(self, task: CaseTask) -> None:
        """Hand a case to the worker; one that has just died is noticed by its sentinel."""
        self.task, self.since = task, time.monotonic()
        with suppress(OSError):
            self.connection.send(task)

    def end(self) -> None:
        """Kill the process."""
        self.process.kill()
        self.process.join()
        self.connection.close()


class TaskQueue:
    """Cases in groups, by folder: a worker that has a group's patient in memory gets the next case of that group."""

    def __init__(self, tasks: Iterable[CaseTask]) -> None:
        self._groups: dict[str, deque[CaseTask]] = {}
        for task in tasks:
            self._groups.setdefault(group_of(task), deque()).append(task)
        self._taken: set[str] = set()

    def __bool__(self) -> bool:
        return bool(self._groups)

    def next(self, last: CaseTask | None) -> CaseTask:
        """The next case for a worker: of its last one's group, of one that nobody is at, or of any."""
        mine = None if last is None else group_of(last)
        fresh = (name for name in self._groups if name not in self._taken)
        name = mine if mine in self._groups else next(fresh, next(iter(self._groups)))
        self._taken.add(name)
        task = self._groups[name].popleft()
        if not self._groups[name]:
            del self._groups[name]
        return task

    def again(self, task: CaseTask) -> None:
        """Requeue a case before the others of its group."""
        self._groups.setdefault(group_of(task), deque()).appendleft(task)


def group_of(task: CaseTask) -> str:
    """Folder of a case's files: a guess at the patient, which decides which worker runs it and nothing else."""
    return str(Path(task.planned.path).parent)


def run_tasks(jobs: int, tasks: Iterable[CaseTask], limits: Limits) -> Generator[CaseEnd, None, None]:
    """Run cases in workers; yields how each ended, as they end."""
    if limits.memory_mb is not None and not Path(STATM.format(os.getpid())).exists():
        refuse("memory cannot be monitored on this system", "--memory-mb", "a system with /proc", "memory_not_watched")
    queue, workers = TaskQueue(tasks), list[_Worker]()
    try:
        while queue or workers:
            while queue and len(workers) < jobs:
                # Ctrl-C waits until the worker is listed (one that is not would be left alone), which never sees it.
                before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
                try:
                    workers.append(_started(queue.next(None), limits))
                finally:
                    signal.pthread_sigmask(signal.SIG_SETMASK, before)
            handles = [handle for one in workers for handle in (one.connection, one.process.sentinel)]
            heard = wait(handles, timeout=LOOK_EVERY_S)  # that have sent something, or have died
            for worker in [one for one in workers if one.connection in heard or one.process.sentinel in heard]:
                yield from _heard(worker, workers, queue)
            for worker in list(workers):
                reason = _beyond(worker, limits)
                if reason:
                    workers.remove(worker)
                    worker.end()
                    yield failed(worker.task, reason)
    finally:
        for worker in workers:
            worker.end()


def _started(task: CaseTask, limits: Limits) -> _Worker:
    """A new process that begins with a case as soon as its modules are loaded."""
    ours, theirs = SPAWN.Pipe()
    memory_bytes = MEMORY_BYTES if limits.memory_mb is None else min(MEMORY_BYTES, limits.memory_mb * 1_000_000 // 4)
    process = SPAWN.Process(target=work, args=(theirs, memory_bytes), daemon=True)
    process.start()
    theirs.close()
    return _Worker(process, ours, task)


def _heard(worker: _Worker, workers: list[_Worker], queue: TaskQueue) -> Iterator[CaseEnd]:
    try:
        message = worker.connection.recv() if worker.connection.poll() else None
    except (EOFError, OSError):
        message = None
    if message == READY:
        worker.ready = True
        worker.assign(worker.task)
    elif isinstance(message, CaseEnd):
        yield message
        if queue:
            worker.assign(queue.next(worker.task))
        else:
            workers.remove(worker)
            worker.end()
    elif not worker.process.is_alive():
        workers.remove(worker)
        worker.end()
        if worker.task.attempt < TRIES and ended(worker.task) is None:  # a result from before the death counts
            queue.again(replace(worker.task, attempt=worker.task.attempt + 1))
        else:
            yield failed(worker.task, WORKER_DIED)


def _beyond(worker: _Worker, limits: Limits) -> str:
    if not worker.ready:
        return ""
    if limits.timeout_s is not None and time.monotonic() - worker.since > limits.timeout_s:
        return TIMED_OUT
    if limits.memory_mb is not None:
        with suppress(OSError, IndexError):  # it may be gone
            pages = Path(STATM.format(worker.process.pid)).read_text(encoding="ascii").split()[1]
            if int(pages) * os.sysconf("SC_PAGE_SIZE") > limits.memory_mb * 1_000_000:
                return OUT_OF_MEMORY
    return ""
