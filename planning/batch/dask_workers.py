"""The same cases on the workers of a ``dask.distributed`` scheduler, on as many machines as it has.

Dask runs a task again whose worker died, finished or not: every case is run at least once, and committed exactly once,
because its result appears by a rename that only the first can make. The cohort, its output folder and this package are
where every worker sees them under one path; a worker reads a patient's files itself, and keeps meshes and trees in
memory by the hash of their bytes, so that no mesh travels with a case.
"""

from __future__ import annotations

import threading
from collections.abc import Generator, Sequence
from typing import Any

from puncture_twin.planning.base.cache.memory import MEMORY_BYTES, Memory
from puncture_twin.planning.base.errors import InputError, one_line
from puncture_twin.planning.base.extras import require_extra
from puncture_twin.planning.batch.run import RunTasks
from puncture_twin.planning.batch.run_case import CaseEnd, CaseTask, commit_failure, ended, run_case
from puncture_twin.planning.batch.workers import NO_LIMITS, WORKER_DIED, Limits

CONNECT_S = 20.0
"""So long a scheduler may take to answer."""

KEPT = "puncture_twin_kept"
"""Attribute of Dask's worker object: what this process keeps, and who is at it."""


class _Kept:
    """Of one worker process. Its threads run one case at a time: FCL's objects are moved for each question."""

    def __init__(self) -> None:
        self.memory = Memory(MEMORY_BYTES)
        self.turn = threading.Lock()


def on_scheduler(address: str) -> RunTasks:
    """Whoever runs cases on a scheduler's workers.

    Args:
        address: Such as ``tcp://10.0.0.1:8786``.

    Raises:
        InputError: The extra ``dask`` is not installed.
    """
    require_extra("dask", "--scheduler")
    import distributed

    def run(tasks: Sequence[CaseTask], limits: Limits) -> Generator[CaseEnd, None, None]:
        if limits != NO_LIMITS:
            what = "memory and time of a case are limited by Dask's workers"
            raise InputError(what, where="--scheduler", allowed="dask worker --memory-limit alone")
        try:
            library: Any = distributed
            client = library.Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            what = f"no scheduler answers there ({one_line(str(error), 150)})"
            raise InputError(what, where=f"--scheduler {address[:80]}", allowed="tcp://HOST:PORT of one") from error
        with client:
            yield from _ends(distributed, client, tasks)

    return run


def _ends(distributed: Any, client: Any, tasks: Sequence[CaseTask]) -> Generator[CaseEnd, None, None]:
    """How each case ended, as they end; one that killed its workers gets its row here."""
    futures = {client.submit(run_on_worker, task, pure=False): task for task in tasks}
    try:
        for future in distributed.as_completed(list(futures), loop=client.loop):
            task = futures.pop(future)
            error = future.exception() if future.status == "error" else None
            if future.status not in ("error", "finished"):
                what = f"the scheduler has lost a case ({future.status})"
                raise InputError(what, where="--scheduler", allowed="a scheduler that stays; what is done is kept")
            if error is None:
                yield future.result()
            elif isinstance(error, distributed.KilledWorker):
                yield _killed(task)
            else:
                raise error
            future.release()
    finally:
        client.cancel(list(futures))


def _killed(task: CaseTask) -> CaseEnd:
    """Its row; or the result that was there before its worker died."""
    return ended(task) or commit_failure(task, WORKER_DIED)


def run_on_worker(task: CaseTask) -> CaseEnd:
    """Run a case in a worker's process, one at a time."""
    from distributed import get_worker

    kept: _Kept = vars(get_worker()).setdefault(KEPT, _Kept())
    with kept.turn:
        return run_case(task, kept.memory)
