"""How many processes of this machine a piece of work may have."""

from __future__ import annotations

import os


def worker_count(wanted: int, pieces: int) -> int:
    """Processes for some pieces of work: no more than wanted, than the processor's cores, or than pieces.

    Args:
        wanted: What the caller asks for; any number.
        pieces: Of the work.

    Returns:
        At least 1.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(wanted, cores, pieces))
