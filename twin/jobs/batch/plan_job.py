"""``batch plan``: what a cohort is made of, written down with the hash of every input."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.batch.cohort.read_cohort import read_cohort
from puncture_twin.planning.batch.estimate import Estimate, estimate
from puncture_twin.planning.batch.plan import PLAN_NAME, PlannedCase, planned, write_plan_table
from puncture_twin.planning.batch.result import read_row

PLAN_ENTRY = "batch plan"
"""Of the folder's manifest."""


@dataclass(frozen=True)
class PlanRun:
    """A cohort's plan, and where it was written, if it was.

    Attributes:
        cases: The plan's rows.
        out: The cohort's folder.
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
