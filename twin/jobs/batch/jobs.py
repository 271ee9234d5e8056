"""``batch plan``, ``batch run`` and ``batch merge``: a cohort's inputs listed, run in parts, and made one table."""

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
from puncture_twin.planning.batch import merge, run
from puncture_twin.planning.batch.cohort import read_cohort
from puncture_twin.planning.batch.plan import (
    PLAN_NAME,
    PlannedCase,
    planned,
    read_plan_table,
    read_row,
    write_plan_table,
)
from puncture_twin.planning.batch.run_case import Limits
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.twin.jobs.batch.report import write_cohort_page
from puncture_twin.twin.jobs.patient.run import Run

PLAN_ENTRY = "batch plan"  # of the folder's manifest


@dataclass(frozen=True)
class PlanRun:
    """A cohort's plan, how many cases have a row already, and of a dry run alone how long all will take."""

    cases: tuple[PlannedCase, ...]
    out: Path
    known: int
    guess: run.Estimate | None = None

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
        if (guess := self.guess) is not None:
            found["estimate"] = {
                "sample": guess.sample,
                "seconds_per_case": round(guess.seconds, 3),
                "seconds": round(guess.seconds * (guess.cases - guess.refused) / jobs, 1),
                "memory_mb": round(guess.memory_bytes * jobs / 1e6),
                "disk_mb": round(guess.disk_bytes / 1e6, 1),
            }
        return found


def plan_cohort(cohort: Path, out: Path, *, arm: bool | None, dry: bool, watcher: Watcher) -> PlanRun:
    """Read every case of a cohort and write ``plan.parquet``; a dry run measures one case and writes nothing."""
    listed, inputs = read_cohort(cohort)
    rows: list[PlannedCase] = []
    for row in planned(listed, arm):
        rows.append(row)
        watcher.count("cases", len(rows), len(listed))
    known = sum(read_row(out, one) is not None for one in {row.id for row in rows}) if out.is_dir() else 0
    if dry:
        return PlanRun(tuple(rows), out, known, run.estimate(rows))
    with writing(out, PLAN_ENTRY, inputs=inputs, names=[PLAN_NAME], note=watcher.note) as draft:
        write_plan_table(rows, draft.folder / PLAN_NAME)
    return PlanRun(tuple(rows), out, known)


def run_part(
    out: Path, typed: str | None, scheduler: str | None, jobs: int, limits: Limits, watcher: Watcher, *, pages: bool
) -> run.RunCounts:
    """Run what has no final row yet, of a part as typed, else as SLURM's array says; `scheduler` is one of Dask."""
    part = run.slurm_part(os.environ) if typed is None else run.parse_part(typed)
    if typed is None and part is not None:
        watcher.note(
            f"part {part.text}, from SLURM's array ({run.TASK}={os.environ[run.TASK]}); --part i/n overrides it"
        )
    write_page = _write_case_page if pages else None
    elsewhere = None if scheduler is None else run.on_scheduler(scheduler)
    return run.run_cohort(
        out, watcher, part=part or run.WHOLE, jobs=jobs, limits=limits, write_page=write_page, elsewhere=elsewhere
    )


def _write_case_page(context: CaseContext, candidates: Candidates, folder: Path) -> None:
    from puncture_twin.twin.jobs.patient.pictures import with_pictures  # with matplotlib

    with_pictures(Run(context, candidates, ()), folder)


def run_summary(out: Path, counts: run.RunCounts) -> dict[str, Any]:
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
MERGE_ENTRY = "batch merge"  # of the folder's manifest


@dataclass(frozen=True, repr=False)
class Merged(Shown):
    """A merged cohort, its files, and the cases that are not as they were expected, None where nothing was."""

    rows: Sequence[dict[str, Any]]
    files: tuple[Path, ...]
    changed: tuple[merge.CaseChange, ...] | None = None

    def to_pandas(self) -> Any:
        """``cases.parquet`` as a pandas DataFrame: a row a case; pandas must be installed."""
        require_extra("pandas", "to_pandas")
        import pyarrow as pa

        return pa.Table.from_pylist(list(self.rows), merge.SCHEMA).to_pandas()

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
        changed = {} if self.changed is None else {"changed": [change_summary(one) for one in self.changed]}
        return {"cases": len(self.rows), **counts, "files": [str(path) for path in self.files], **changed}


CODES = {"safe": 0, "no_safe": 1, "refused": 2, "program_failed": 3, "not_run": None}  # what a row's exit code means


def change_summary(change: merge.CaseChange) -> dict[str, Any]:
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
    """Write ``cases.parquet``, the dataset of candidates and the page; best clearances may differ by the tolerance."""
    plan = read_plan_table(out)
    expected = None if expect is None else merge.read_cases(expect)
    inputs, made_from = [Input("plan", PLAN_NAME, plan.sha256)], {PLAN_NAME: plan.sha256}
    names = [merge.CASES_NAME, PAGE_NAME]
    with writing(out, MERGE_ENTRY, inputs=inputs, names=names, made_from=made_from, note=watcher.note) as draft:
        rows = merge.merged_rows(plan.cases, out)
        merge.write_cases(rows, draft.folder / merge.CASES_NAME)
        merge.write_dataset(rows, out, draft.folder / merge.DATASET_NAME, partial(watcher.count, "tables"))
        write_cohort_page(out.absolute().name, rows, inputs, draft.folder / PAGE_NAME)
    files = tuple(out / name for name in (merge.CASES_NAME, merge.DATASET_NAME, PAGE_NAME, MANIFEST_NAME))
    changed = None if expected is None else tuple(merge.compare(expected, rows).beyond(tolerance_mm))
    return Merged(rows, files, changed)
