"""How long a piece of work takes on a machine that others share."""

from __future__ import annotations

import time
from collections.abc import Callable


def least_seconds(work: Callable[[], object], repeats: int) -> float:
    """The least processor time of this thread over some repeats, s; a first one, which compiles, is not counted."""
    work()
    times = []
    for _ in range(repeats):
        start = time.thread_time()
        work()
        times.append(time.thread_time() - start)
    return min(times)
