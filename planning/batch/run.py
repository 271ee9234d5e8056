"""Runs of a cohort: all of it or a part ``i/n``, on this machine or a scheduler's; its state, and an estimate.

Cases are run by one process at a time until each has a row; what has one is left as it is. Dask runs a task again whose
worker died, finished or not: every case is run at least once, and committed exactly once, because its result appears by
a rename that only the first can make. The cohort, its output folder and this package are where every worker sees them
under one path; a worker reads a patient's files itself, and keeps meshes and trees in memory by their bytes.
"""

import fcntl
import os
import re
import resource
import shutil
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from puncture_twin.planning.base.cache.array_cache import MEMORY_BYTES, Memory
from puncture_twin.planning.base.errors import InputError, one_line, refuse, require_extra
from puncture_twin.planning.base.output.output_set import disk_is_full
from puncture_twin.planning.base.processes import worker_count
from puncture_twin.planning.base.progress import Count, Watcher
from puncture_twin.planning.batch import plan as plans, run_case as workers
from puncture_twin.planning.batch.run_case import NO_LIMITS, CaseEnd, CaseTask, Limits, WritePage, run_case

Item = TypeVar("Item")
ALLOWED_PARTS = "i/n with 1 <= i <= n, such as 3/8"
TASK, COUNT, FIRST, STEP = (f"SLURM_ARRAY_TASK_{name}" for name in ("ID", "COUNT", "MIN", "STEP"))
"""Environment variables of each task of a SLURM array: https://slurm.schedmd.com/job_array.html."""


class Part(NamedTuple):
    """Part ``number`` of ``parts``, from 1 on."""

    number: int
    parts: int

    @property
    def text(self) -> str:
        """The part as it is typed."""
        return f"{self.number}/{self.parts}"

    def of(self, items: Sequence[Item]) -> Sequence[Item]:
        """The items of this part: neighbours stay together, and every item is in one part."""
        size = len(items)
        return items[(self.number - 1) * size // self.parts : self.number * size // self.parts]


WHOLE = Part(1, 1)


def parse_part(text: str) -> Part:
    """A part as it is typed; anything else is refused."""
    match = re.fullmatch(r"([0-9]{1,7})/([0-9]{1,7})", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        refuse(f"'{text[:40]}' is not a part", "--part", ALLOWED_PARTS, "bad_part")
    return Part(int(match[1]), int(match[2]))


def slurm_part(environment: Mapping[str, str]) -> Part | None:
    """The part of this task of a SLURM array; None outside of one. One from which it cannot be inferred is refused."""
    if TASK not in environment:
        return None
    stated = {name: environment.get(name, "1" if name == STEP else "") for name in (TASK, COUNT, FIRST, STEP)}
    if not all(re.fullmatch(r"[0-9]{1,9}", value) for value in stated.values()):
        refuse(f"{stated} are not numbers", "SLURM's array", f"--part {ALLOWED_PARTS}", "bad_part")
    task, count, first, step = (int(stated[name]) for name in (TASK, COUNT, FIRST, STEP))
    place, remainder = divmod(task - first, max(step, 1))
    if remainder or not 0 <= place < count:
        what = f"task {task} of an array of {count} from {first} in steps of {step}"
        refuse(what, "SLURM's array", f"an array without gaps, or --part {ALLOWED_PARTS}", "bad_part")
    return Part(place + 1, count)


RunTasks = Callable[[Sequence[CaseTask], Limits], Generator[CaseEnd, None, None]]
"""A function that runs cases somewhere, and yields how each ended."""
LOCK_NAME = ".puncture-twin-run-lock"
ALLOWED_AT_ONCE = "one run at a time, parallel parts (--part i/n), or another folder"


@dataclass
class RunCounts:
    """Counts of one run."""

    planned: int
    same: int  # planned cases that are others to the byte: they are run once
    before: int  # others that had their rows, of which ``refused_before`` were refused
    refused_before: int = 0
    ended: Counter[int] = field(default_factory=Counter)  # exit code of a row to how many rows
    reasons: Counter[str] = field(default_factory=Counter)  # of rows whose exit code is above 1
    stale: int = 0  # cases whose files are not those of the plan; they have no row

    @property
    def failed(self) -> int:
        """Cases that this run has left without a verdict so far."""
        return self.stale + sum(count for code, count in self.ended.items() if code > 1)

    @property
    def whole(self) -> bool:
        """Whether every case of the part has a verdict, whichever run gave it."""
        return not (self.failed or self.refused_before)

    def add(self, end: CaseEnd) -> None:
        """Count one more case."""
        if end.exit_code is None:
            self.stale += 1
            return
        self.ended[end.exit_code] += 1
        if end.exit_code > 1:
            self.reasons[end.reason or ""] += 1


def run_cohort(
    out: Path,
    watcher: Watcher,
    *,
    part: Part = WHOLE,
    jobs: int = 1,
    limits: Limits = NO_LIMITS,
    write_page: WritePage | None = None,
    elsewhere: RunTasks | None = None,
) -> RunCounts:
    """Run the cases of a plan that have no final row yet.

    Args:
        jobs: Processes of this machine, at most one a core.
        write_page: Writes a page for each case that is searched, or None.
        elsewhere: Runs the cases; None runs them in processes of this machine.

    Raises:
        InputError: No plan, one of another version, another run in the folder, or a disk that takes no more.
    """
    plan = plans.read_plan_table(out)
    if plan.version != plans.program():
        what = f"the plan is of version {plan.version}, this program is {plans.program()}"
        refuse(what, out, "repeat batch plan: unchanged results are kept", "unknown_version")
    with running(out, part) as work:
        rows = part.of(plan.cases)
        cases = distinct(rows)
        cached = [plans.read_row(out, one.id) for one in cases]
        tasks = []
        for one, row in zip(cases, cached, strict=True):
            if not plans.is_final(row):
                plans.discard(out, one.id, work)  # a failure of the program, or half a result
                tasks.append(CaseTask(one, out, work, write_page))
        refused = sum(row["exit_code"] > 1 for row in cached if row is not None and plans.is_final(row))
        counts = RunCounts(len(rows), len(rows) - len(cases), len(cases) - len(tasks), refused)
        watcher.count("cases", 0, len(tasks))
        run = elsewhere or partial(workers.run_tasks, worker_count(jobs, len(tasks)))
        with closing(run(tasks, limits)) as ends:
            for done, end in enumerate(ends, start=1):
                if end.full:
                    what = f"cannot be written ({end.full}); finished cases are kept"
                    refuse(what, out, "a folder with enough free space", "unwritable")
                counts.add(end)
                watcher.count("cases", done, len(tasks), counts.failed)
    return counts


def distinct(cases: Iterable[plans.PlannedCase]) -> list[plans.PlannedCase]:
    """The first case of each id: the same bytes, options and program have one answer."""
    return list({one.id: one for one in reversed(list(cases))}.values())[::-1]


@contextmanager
def running(out: Path, part: Part) -> Iterator[Path]:
    """Lock a part of a cohort, or refuse; yields a folder for drafts, which is removed in the end.

    The system frees the locks of a process that dies; its folder is removed by the next run of the part, or of all.
    """
    work = out / f"{plans.WORK_PREFIX}{part.number}-of-{part.parts}"
    with ExitStack() as stack:
        try:
            stack.enter_context(_locked(out, LOCK_NAME, fcntl.LOCK_EX if part == WHOLE else fcntl.LOCK_SH))
            if part != WHOLE:
                stack.enter_context(_locked(out, f"{LOCK_NAME}-{part.number}-of-{part.parts}", fcntl.LOCK_EX))
            for left in out.glob(f"{plans.WORK_PREFIX}*") if part == WHOLE else [work]:
                shutil.rmtree(left, ignore_errors=True)
            work.mkdir(exist_ok=True)
        except OSError as error:
            full = disk_is_full(error, out)
            allowed = "a folder with enough free space" if full else "a folder that may be written to"
            what = f"cannot be written ({error.strerror})"
            raise InputError(what, where=out, allowed=allowed, code="unwritable") from error
        stack.callback(shutil.rmtree, work, ignore_errors=True)
        yield work


@contextmanager
def _locked(out: Path, name: str, kind: int) -> Iterator[None]:
    handle = os.open(out / name, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(handle, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        what = "another run is using this folder"
        raise InputError(what, where=out, allowed=ALLOWED_AT_ONCE, code="folder_in_use") from None
    try:
        yield
    finally:
        os.close(handle)


COPIES = 2
"""Copies of each table: the case's own, and that of the merged dataset."""


@dataclass(frozen=True)
class Estimate:
    """Estimated time (a case, in a warm worker), disk (of all, run and merged) and memory (of a worker) of a cohort.

    By the case that was measured, as the cohort writes it; None where none can be read.
    """

    cases: int
    refused: int
    sample: str | None = None
    seconds: float = 0.0
    disk_bytes: int = 0
    memory_bytes: int = 0


def estimate(cases: Sequence[plans.PlannedCase]) -> Estimate:
    """Estimate a cohort from its first case that can be read, run twice, the second time warm."""
    readable = [one for one in cases if not one.refusal]
    count, refused = len(cases), len(cases) - len(readable)
    if not readable:
        return Estimate(count, refused)
    for _ in range(2):
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            run_case(CaseTask(readable[0], Path(folder), Path(folder)))
            seconds = time.perf_counter() - start
            size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return Estimate(count, refused, readable[0].case, seconds, COPIES * size * len(readable), peak)


@dataclass
class CohortState:
    """State of a cohort's cases, each counted once: done, failed (by reason), missing or stale.

    Stale are those whose inputs have changed since the plan: `batch plan` again.
    """

    planned: int = 0
    safe: int = 0
    no_safe: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    missing: int = 0
    stale_cases: list[str] = field(default_factory=list)

    @property
    def done(self) -> int:
        """Cases with a verdict."""
        return self.safe + self.no_safe

    @property
    def failed(self) -> int:
        """Cases whose row is a refusal or a failure."""
        return sum(self.reasons.values())

    @property
    def stale(self) -> int:
        """Cases whose inputs have changed."""
        return len(self.stale_cases)

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        reasons = [{"reason": reason, "count": count} for reason, count in self.reasons.most_common()]
        done = {"cases": self.planned, "done": self.done, "safe": self.safe, "no_safe": self.no_safe}
        rest = {"missing": self.missing, "stale": self.stale, "stale_cases": self.stale_cases}
        return {**done, "failed": self.failed, "reasons": reasons, **rest}

    def add(self, planned: plans.PlannedCase, out: Path) -> None:
        """Count one more case; its files are read and hashed."""
        self.planned += 1
        row = plans.read_row(out, planned.id)
        if plans.identified(planned).id != planned.id:
            self.stale_cases.append(planned.case)
        elif row is None:
            self.missing += 1
        elif row["exit_code"] > 1:
            self.reasons[str(row["reason"])] += 1
        elif row["exit_code"] == 1:
            self.no_safe += 1
        else:
            self.safe += 1


def cohort_state(out: Path, progress: Count) -> CohortState:
    """The state of every case of a folder's plan. Raises InputError: The folder has no plan."""
    plan, state = plans.read_plan_table(out), CohortState()
    for number, one in enumerate(plan.cases, start=1):
        state.add(one, out)
        progress(number, len(plan.cases))
    return state


CONNECT_S, WORKER_CACHE = 20.0, "puncture_twin_kept"
"""Seconds that a scheduler may take to answer. Attribute of Dask's worker object: what it keeps, and a lock."""


def on_scheduler(address: str) -> RunTasks:
    """Make a function that runs cases on the workers of a scheduler, such as at ``tcp://10.0.0.1:8786``."""
    require_extra("dask", "--scheduler")
    import distributed

    def run(tasks: Sequence[CaseTask], limits: Limits) -> Generator[CaseEnd, None, None]:
        if limits != NO_LIMITS:
            what = "Dask's workers limit the memory and time of a case"
            refuse(what, "--scheduler", "only dask worker --memory-limit", "dask_limits")
        try:
            library: Any = distributed
            client = library.Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            what = f"no scheduler answers at this address ({one_line(str(error), 150)})"
            where = f"--scheduler {address[:80]}"
            allowed = "tcp://HOST:PORT of a running scheduler"
            raise InputError(what, where=where, allowed=allowed, code="no_scheduler") from error
        with client:
            yield from _dask_ends(distributed, client, tasks)

    return run


def _dask_ends(distributed: Any, client: Any, tasks: Sequence[CaseTask]) -> Generator[CaseEnd, None, None]:
    """How each case ended, as they end; one that killed its workers gets its row here."""
    futures = {client.submit(run_on_worker, task, pure=False): task for task in tasks}
    try:
        for future in distributed.as_completed(list(futures), loop=client.loop):
            task = futures.pop(future)
            error = future.exception() if future.status == "error" else None
            if future.status not in ("error", "finished"):
                allowed = "a scheduler that keeps running; finished cases are kept"
                refuse(f"the scheduler has lost a case ({future.status})", "--scheduler", allowed, "scheduler_lost")
            if error is None:
                yield future.result()
            elif isinstance(error, distributed.KilledWorker):
                yield workers.failed(task, workers.WORKER_DIED)  # it killed its workers
            else:
                raise error
            future.release()
    finally:
        client.cancel(list(futures))


def run_on_worker(task: CaseTask) -> CaseEnd:
    """Run a case in a worker's process, one at a time: FCL's objects are moved for each query."""
    from distributed import get_worker

    fresh = Memory(MEMORY_BYTES), threading.Lock()
    memory, lock = vars(get_worker()).setdefault(WORKER_CACHE, fresh)
    with lock:
        return run_case(task, memory)
