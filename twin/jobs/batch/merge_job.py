"""``batch merge``: one table, one dataset and one page of a cohort."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.output.manifest import MANIFEST_NAME
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.batch.compare import CaseChange, compare, read_cases
from puncture_twin.planning.batch.merge import CASES_NAME, DATASET_NAME, merged_rows, write_cases, write_dataset
from puncture_twin.planning.batch.plan import PLAN_NAME, read_plan_table
from puncture_twin.twin.jobs.batch.page import write_cohort_page

PAGE_NAME = "cohort.html"
MERGE_ENTRY = "batch merge"
"""Of the folder's manifest."""


@dataclass(frozen=True)
class Merged:
    """A merged cohort.

    Attributes:
        rows: Of ``cases.parquet``.
        files: That were written; of the dataset its folder.
        changed: Cases that are not as they were expected; None where nothing was.
    """

    rows: Sequence[dict[str, Any]]
    files: tuple[Path, ...]
    changed: tuple[CaseChange, ...] | None = None

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
        out: The cohort's folder.
        expect: An earlier ``cases.parquet``, or the folder of one, against which the verdicts are held.
        tolerance_mm: By so much a best clearance may differ from it.
        watcher: Whoever shows progress.

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
