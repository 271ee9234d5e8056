"""``batch run``: a cohort or a part of it, on this machine or on a scheduler's workers."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.batch.part import TASK, WHOLE, Part, parse_part, slurm_part
from puncture_twin.planning.batch.run import Request, RunCounts, RunTasks, run_cohort
from puncture_twin.planning.batch.workers import Limits
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.twin.jobs.patient.pictures import with_pictures
from puncture_twin.twin.jobs.patient.run import Run


@dataclass(frozen=True)
class Where:
    """Who runs a part.

    Attributes:
        part: As it was typed, or None.
        scheduler: Address of a Dask scheduler, or None for processes of this machine.
        jobs: Processes of this machine.
        pages: Whether each case gets its page.
        limits: Of each case.
    """

    part: str | None
    scheduler: str | None
    jobs: int
    pages: bool
    limits: Limits


def run_part(out: Path, where: Where, watcher: Watcher, environment: Mapping[str, str] = os.environ) -> RunCounts:
    """Run what has no final row yet.

    Raises:
        InputError: See `run_cohort`; or a part that cannot be told.
    """
    part = _part(where.part, watcher, environment)
    write_page = write_case_page if where.pages else None
    request = Request(part, where.jobs, where.limits, write_page)
    return run_cohort(out, request, watcher, _elsewhere(where.scheduler))


def _part(typed: str | None, watcher: Watcher, environment: Mapping[str, str]) -> Part:
    """As typed, else as SLURM's array says it, which is told."""
    if typed is not None:
        return parse_part(typed)
    part = slurm_part(environment)
    if part is None:
        return WHOLE
    watcher.note(f"part {part.text}, from SLURM's array ({TASK}={environment[TASK]}); --part i/n overrides it")
    return part


def _elsewhere(scheduler: str | None) -> RunTasks | None:
    if scheduler is None:
        return None
    from puncture_twin.planning.batch.dask_workers import on_scheduler

    return on_scheduler(scheduler)


def write_case_page(context: CaseContext, found: Candidates, folder: Path) -> None:
    """A case's map, scene, slices and page, as `search` writes them."""
    with_pictures(Run(context, found, ()), folder)


def run_summary(out: Path, counts: RunCounts) -> dict[str, Any]:
    """Plain values for JSON."""
    return {
        "out": str(out),
        "cases": counts.planned,
        "same": counts.same,
        "before": counts.before,
        "refused_before": counts.refused_before,
        "done": counts.ended[0] + counts.ended[1],
        "failed": counts.failed,
        "reasons": [{"reason": reason, "count": count} for reason, count in counts.reasons.most_common()],
        "stale": counts.stale,
    }
