"""A worker: a process that runs one case after the other, and goes when whoever started it is gone."""

from __future__ import annotations

import multiprocessing
import os
import threading
from multiprocessing.connection import Connection, wait

from puncture_twin.planning.base.cache.memory import Memory
from puncture_twin.planning.batch.run_case import CaseTask, run_case

READY = "ready"
"""A worker's first word: its modules are loaded."""

MEMORY_BYTES = 500_000_000
"""What a worker keeps of patients: the meshes and trees of some ten whole bodies."""


def work(connection: Connection, memory_bytes: int) -> None:
    """Run what comes until nothing more does.

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
