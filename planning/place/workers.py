"""One question to many things, on this machine's processes; the answers come in order, however many there are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import TypeVar

from puncture_twin.planning.base.processes import worker_count

Thing = TypeVar("Thing")
Answer = TypeVar("Answer")

BATCH = 48
"""At most so many things at a time go to a process."""


def ask_all(
    ask: Callable[[Thing], Answer],
    things: Sequence[Thing],
    *,
    jobs: int,
    progress: Callable[[int, int], None],
) -> list[Answer]:
    """The answers in the order of the things.

    Args:
        ask: The question; with several jobs it and its answers must be such as can be pickled.
        things: What is asked about.
        jobs: Processes, at most one a core; 1 asks in this one.
        progress: Called with (answered, to answer).
    """
    jobs = worker_count(jobs, len(things))
    size = max(1, min(BATCH, len(things) // (4 * jobs)))
    batches = [things[start : start + size] for start in range(0, len(things), size)]
    answers: list[Answer] = []
    if jobs == 1 or len(batches) < 2:
        for batch in batches:
            answers += _batch(ask, batch)
            progress(len(answers), len(things))
        return answers
    with ProcessPoolExecutor(min(jobs, len(batches))) as pool:
        for some in pool.map(partial(_batch, ask), batches):
            answers += some
            progress(len(answers), len(things))
    return answers


def _batch(ask: Callable[[Thing], Answer], things: Sequence[Thing]) -> list[Answer]:
    return [ask(thing) for thing in things]
