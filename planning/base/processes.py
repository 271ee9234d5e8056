"""Work on processes, each of which starts anew (libraries with threads do not survive a fork), and on threads."""

import copyreg
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any


def _mapping(values: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(values)


copyreg.pickle(MappingProxyType, lambda mapping: (_mapping, (dict(mapping),)))
# Read-only mappings go to other processes as what they are: a case and its structures hold some.


def worker_count(wanted: int, pieces: int) -> int:
    """Processes for some pieces of work: no more than wanted, than the processor's cores, or than pieces; 1 or more."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(wanted, cores, pieces))


def _begin_worker() -> None:
    """Ctrl-C is the command's, which ends its workers; and no worker outlives a command that was killed.

    What a library prints goes to standard error: standard output is the command's answer.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.dup2(2, 1)
    command = multiprocessing.parent_process()
    assert command is not None
    threading.Thread(target=_end_with, args=(command,), daemon=True).start()


def _end_with(command: Any) -> None:
    command.join()
    os._exit(1)


@contextmanager
def process_pool(jobs: int, pieces: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of `worker_count` spawned processes; where the block ends early, as by Ctrl-C, nothing more begins."""
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(worker_count(jobs, pieces), mp_context=context, initializer=_begin_worker)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def working(jobs: int, pieces: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """A function like ``map``, in this process or in several; a function and its results must then be pickled.

    ``jobs``: processes, at most one a core; 1 computes in this one, each piece when its result is taken.
    """
    if worker_count(jobs, pieces) == 1:
        yield map
        return
    with process_pool(jobs, pieces) as pool:
        yield pool.map


def on_threads(work: Callable[[int], None], pieces: int, threads: int) -> Iterator[int]:
    """Do pieces of work that let go of the interpreter, side by side; yields how many are done."""
    threads = worker_count(threads, pieces)
    if threads == 1:
        for piece in range(pieces):
            work(piece)
            yield piece + 1
        return
    pool = ThreadPoolExecutor(threads)
    try:
        for done, one in enumerate(as_completed([pool.submit(work, piece) for piece in range(pieces)])):
            one.result()
            yield done + 1
    finally:
        pool.shutdown(cancel_futures=True)
