"""How long a cohort will take, and how much memory and disk: measured at its first case that can be read."""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from puncture_twin.planning.batch.plan import PlannedCase
from puncture_twin.planning.batch.run_case import CaseTask, run_case

COPIES = 2
"""Of each table: the case's own, and that of the merged dataset."""


@dataclass(frozen=True)
class Estimate:
    """Of a cohort.

    Attributes:
        cases: In all.
        refused: That cannot be read.
        sample: The case that was measured, as the cohort writes it; None where none can be read.
        seconds: A case, in a worker that is warm.
        disk_bytes: Of all cases, run and merged.
        memory_bytes: Of one worker, at its most.
    """

    cases: int
    refused: int
    sample: str | None = None
    seconds: float = 0.0
    disk_bytes: int = 0
    memory_bytes: int = 0


def estimate(cases: Sequence[PlannedCase]) -> Estimate:
    """Run the first case that can be read twice, the second time warm, and take all others to be like it.

    Args:
        cases: The plan's.
    """
    readable = [one for one in cases if not one.refusal]
    refused = len(cases) - len(readable)
    if not readable:
        return Estimate(len(cases), refused)
    for _ in range(2):
        with tempfile.TemporaryDirectory() as folder:
            start = time.perf_counter()
            run_case(CaseTask(readable[0], Path(folder), Path(folder)))
            seconds = time.perf_counter() - start
            size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return Estimate(len(cases), refused, readable[0].case, seconds, COPIES * size * len(readable), peak)
