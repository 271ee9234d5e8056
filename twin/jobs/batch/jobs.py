"""``batch plan``: what a cohort is made of, written down with the hash of every input.

``batch run``: a cohort or a part of it, on this machine or on a scheduler's workers.

``batch merge``: one table, one dataset and one page of a cohort.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.errors import require_extra
from puncture_twin.planning.base.output.manifest import MANIFEST_NAME
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.base.text import Shown
from puncture_twin.planning.batch.cohort import read_cohort
from puncture_twin.planning.batch.merge import (
    CASES_NAME,
    DATASET_NAME,
    SCHEMA,
    CaseChange,
    compare,
    merged_rows,
    read_cases,
    write_cases,
    write_dataset,
)
from puncture_twin.planning.batch.plan import (
    PLAN_NAME,
    PlannedCase,
    planned,
    read_plan_table,
    read_row,
    write_plan_table,
)
from puncture_twin.planning.batch.run import (
    TASK,
    WHOLE,
    Estimate,
    Part,
    RunCounts,
    estimate,
    on_scheduler,
    parse_part,
    run_cohort,
    slurm_part,
)
from puncture_twin.planning.batch.run_case import Limits
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.twin.jobs.batch.report import write_cohort_page
from puncture_twin.twin.jobs.patient.run import Run

PLAN_ENTRY = "batch plan"
"""Of the folder's manifest."""


@dataclass(frozen=True)
class PlanRun:
    """A cohort's plan, and where it was written, if it was.

    Attributes:
        known: Cases that have a row there already.
        guess: How long the cohort will take; of a dry run alone.
    """

    cases: tuple[PlannedCase, ...]
    out: Path
    known: int
    guess: Estimate | None = None

    @property
    def refused(self) -> list[PlannedCase]:
        """Cases that cannot be read; each gets a row with its reason."""
        return [one for one in self.cases if one.refusal]

    def summary(self, jobs: int) -> dict[str, Any]:
        """Plain values for JSON."""
        found: dict[str, Any] = {
            "cases": len(self.cases),
            "refused": [{"case": one.case, "reason": one.refusal} for one in self.refused],
            "known": self.known,
            "files": [] if self.guess else [str(self.out / PLAN_NAME)],
        }
        return found if self.guess is None else found | {"estimate": estimate_summary(self.guess, jobs)}


def estimate_summary(guess: Estimate, jobs: int) -> dict[str, Any]:
    """An estimate as plain values."""
    return {
        "sample": guess.sample,
        "seconds_per_case": round(guess.seconds, 3),
        "seconds": round(guess.seconds * (guess.cases - guess.refused) / jobs, 1),
        "memory_mb": round(guess.memory_bytes * jobs / 1e6),
        "disk_mb": round(guess.disk_bytes / 1e6, 1),
    }


def plan_cohort(cohort: Path, out: Path, *, arm: bool | None, dry: bool, watcher: Watcher) -> PlanRun:
    """Read every case of a cohort and write ``plan.parquet``; a dry run measures one case and writes nothing.

    Raises:
        InputError: No cohort, or a folder that cannot be written to.
    """
    listed, inputs = read_cohort(cohort)
    count, rows = partial(watcher.count, "cases", total=len(listed)), []
    for number, row in enumerate(planned(listed, arm), start=1):
        rows.append(row)
        count(number)
    known = sum(read_row(out, one) is not None for one in {row.id for row in rows}) if out.is_dir() else 0
    if dry:
        return PlanRun(tuple(rows), out, known, estimate(rows))
    with writing(out, PLAN_ENTRY, inputs=inputs, names=[PLAN_NAME], note=watcher.note) as draft:
        write_plan_table(rows, draft.folder / PLAN_NAME)
    return PlanRun(tuple(rows), out, known)


@dataclass(frozen=True)
class Where:
    """Who runs a part.

    Attributes:
        part: As it was typed, or None.
        scheduler: Address of a Dask scheduler, or None for processes of this machine.
    """

    part: str | None
    scheduler: str | None
    jobs: int
    pages: bool
    limits: Limits


def run_part(out: Path, where: Where, watcher: Watcher) -> RunCounts:
    """Run what has no final row yet.

    Raises:
        InputError: See `run_cohort`; or a part that cannot be told.
    """
    part = _part(where.part, watcher)
    write_page = write_case_page if where.pages else None
    elsewhere = None if where.scheduler is None else on_scheduler(where.scheduler)
    return run_cohort(
        out, watcher, part=part, jobs=where.jobs, limits=where.limits, write_page=write_page, elsewhere=elsewhere
    )


def _part(typed: str | None, watcher: Watcher) -> Part:
    """As typed, else as SLURM's array says it, which is told."""
    if typed is not None:
        return parse_part(typed)
    part = slurm_part(os.environ)
    if part is None:
        return WHOLE
    watcher.note(f"part {part.text}, from SLURM's array ({TASK}={os.environ[TASK]}); --part i/n overrides it")
    return part


def write_case_page(context: CaseContext, candidates: Candidates, folder: Path) -> None:
    """A case's map, scene, slices and page, as `search` writes them."""
    from puncture_twin.twin.jobs.patient.pictures import with_pictures  # with matplotlib

    with_pictures(Run(context, candidates, ()), folder)


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


PAGE_NAME = "cohort.html"
MERGE_ENTRY = "batch merge"
"""Of the folder's manifest."""


@dataclass(frozen=True, repr=False)
class Merged(Shown):
    """A merged cohort.

    Attributes:
        files: That were written; of the dataset its folder.
        changed: Cases that are not as they were expected; None where nothing was.
    """

    rows: Sequence[dict[str, Any]]
    files: tuple[Path, ...]
    changed: tuple[CaseChange, ...] | None = None

    def to_pandas(self) -> Any:
        """``cases.parquet`` as a pandas DataFrame: a row a case.

        Raises:
            InputError: pandas is not installed.
        """
        require_extra("pandas", "to_pandas")
        import pyarrow as pa

        return pa.Table.from_pylist(list(self.rows), SCHEMA).to_pandas()

    @property
    def not_run(self) -> int:
        """Cases without a row yet."""
        return sum(row["exit_code"] is None for row in self.rows)

    @property
    def as_expected(self) -> bool:
        """Whether every case has its row, and none changed."""
        return not self.not_run and not self.changed

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        codes = [row["exit_code"] for row in self.rows]
        counts = {name: codes.count(code) for name, code in CODES.items()}
        found = {"cases": len(self.rows), **counts, "files": [str(path) for path in self.files]}
        if self.changed is None:
            return found
        return found | {"changed": [change_summary(one) for one in self.changed]}


CODES = {"safe": 0, "no_safe": 1, "refused": 2, "program_failed": 3, "not_run": None}
"""What a row's exit code means."""


def change_summary(change: CaseChange) -> dict[str, Any]:
    """One case in two cohorts as plain values."""
    return {
        "case": change.case,
        "options": change.options,
        "kind": change.kind,
        "safe": [None if row is None else row["safe"] for row in (change.before, change.after)],
        "moved_mm": change.moved_mm,
        "clearance_change_mm": change.clearance_mm,
    }


def merge_cohort(out: Path, expect: Path | None, tolerance_mm: float, watcher: Watcher) -> Merged:
    """Write ``cases.parquet``, the dataset of candidates and the page.

    Args:
        tolerance_mm: By so much a best clearance may differ from it.

    Raises:
        InputError: No plan, nothing that can be expected, or a folder that cannot be written to.
    """
    plan = read_plan_table(out)
    expected = None if expect is None else read_cases(expect)
    inputs, made_from = [Input("plan", PLAN_NAME, plan.sha256)], {PLAN_NAME: plan.sha256}
    names = [CASES_NAME, PAGE_NAME]
    with writing(out, MERGE_ENTRY, inputs=inputs, names=names, made_from=made_from, note=watcher.note) as draft:
        rows = merged_rows(plan.cases, out)
        write_cases(rows, draft.folder / CASES_NAME)
        write_dataset(rows, out, draft.folder / DATASET_NAME, partial(watcher.count, "tables"))
        write_cohort_page(out.absolute().name, rows, inputs, draft.folder / PAGE_NAME)
    files = tuple(out / name for name in (CASES_NAME, DATASET_NAME, PAGE_NAME, MANIFEST_NAME))
    changed = None if expected is None else tuple(compare(expected, rows).beyond(tolerance_mm))
    return Merged(rows, files, changed)
