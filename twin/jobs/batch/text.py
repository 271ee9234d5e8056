"""What the commands of a cohort print for a person."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.batch.merge import CaseChange, Comparison
from puncture_twin.planning.batch.run import CohortState, RunCounts
from puncture_twin.twin.jobs.batch.jobs import Merged, PlanRun, estimate_summary
from puncture_twin.twin.report.progress import duration_text

MOST_LINES = 10
"""Of a list; the rest is counted. ``--json`` has all."""


def plan_text(run: PlanRun, jobs: int) -> str:
    """How many cases, how many of them are refused or known, and the estimate of a dry run."""
    lines = [f"{_cases(len(run.cases))}, {run.known} with a row already"]
    lines += _listed(f"{one.case}: {one.refusal}" for one in run.refused)
    if run.guess is None:
        return "\n".join([*lines, f"plan: {run.out / 'plan.parquet'}", f"next: run-twin batch run --out {run.out}"])
    if run.guess.sample is None:
        return "\n".join([*lines, "nothing to measure: no case can be read"])
    estimate = estimate_summary(run.guess, jobs)
    lines += [
        f"measured at {estimate['sample']}: {estimate['seconds_per_case']:.2f} s a case",
        f"{jobs} worker{'s' * (jobs > 1)}: about {duration_text(estimate['seconds'])}, "
        f"{estimate['memory_mb']} MB of memory, {estimate['disk_mb']:.1f} MB of disk, "
        "as if every case were like it; nothing was written",
    ]
    return "\n".join(lines)


def run_text(out: Path, counts: RunCounts) -> str:
    """What a run did, and what comes next."""
    done = counts.ended[0] + counts.ended[1]
    refused = f" ({counts.refused_before} refused)" if counts.refused_before else ""
    same = f"{counts.same} the same as others, " if counts.same else ""
    lines = [
        f"{_cases(counts.planned)}: {same}{counts.before} had their row{refused}, {done} done, {counts.failed} failed"
    ]
    lines += _reasons(counts.reasons)
    if counts.stale:
        lines.append(f"{counts.stale:6d}  not run: the inputs have changed since the plan; batch plan again")
    return "\n".join([*lines, f"next: run-twin batch status --out {out}", f"      run-twin batch merge --out {out}"])


def state_text(state: CohortState) -> str:
    """Done, failed with reasons, missing, stale."""
    lines = [
        _cases(state.planned),
        f"{state.done:6d}  done ({state.safe} with a safe direction, {state.no_safe} without)",
        f"{state.failed:6d}  failed",
        *(f"  {line}" for line in _reasons(state.reasons)),
        f"{state.missing:6d}  missing",
        f"{state.stale:6d}  stale: the inputs have changed since the plan",
    ]
    return "\n".join([*lines, *_listed(state.stale_cases)])


def merge_text(merged: Merged) -> str:
    """How many of which kind, the files, and what is not as expected."""
    estimate = merged.summary()
    lines = [
        f"{_cases(estimate['cases'])}: {estimate['safe']} with a safe direction, {estimate['no_safe']} without, "
        f"{estimate['refused'] + estimate['program_failed']} failed ({estimate['refused']} of them refused), "
        f"{estimate['not_run']} not run",
        *(f"wrote {path}" for path in merged.files),
        "of the inputs as they were planned; batch status says which have changed since",
    ]
    if merged.changed is not None:
        lines.append(f"{len(merged.changed)} not as expected")
        lines += _listed(map(change_line, merged.changed))
    return "\n".join(lines)


def compare_text(found: Comparison) -> str:
    """Per case what changed, and in sum."""
    counts, moved = found.counts, found.moved_mm
    lines = [f"{_cases(len(found.changes))}: " + ", ".join(f"{counts[kind]} {kind}" for kind in sorted(counts))]
    if moved:
        lines.append(
            f"best entries of the {len(moved)} that are safe in both moved by {np.median(moved):.2f} mm (median), "
            f"{max(moved):.2f} mm at most"
        )
    changed = [one for one in found.changes if one.kind != "same" or one.moved_mm]
    return "\n".join([*lines, *_listed(map(change_line, changed))])


def change_line(change: CaseChange) -> str:
    """One case in two cohorts."""
    before, after = ("-" if row is None else _verdict(row) for row in (change.before, change.after))
    moved = "" if change.moved_mm is None else f"; best entry moved {change.moved_mm:.2f} mm"
    more = "" if change.clearance_mm is None else f", clearance {change.clearance_mm:+.3f} mm"
    options = "" if change.options == "{}" else f" {change.options}"
    return f"{change.case}{options}: {change.kind}: {before} -> {after}{moved}{more}"


def _verdict(row: Any) -> str:
    return f"{row['safe']} safe" if row["reason"] is None else str(row["reason"])


def _cases(count: int) -> str:
    return f"{count} case{'s' if count != 1 else ''}"


def _reasons(reasons: Counter[str]) -> list[str]:
    shown = [f"{count:6d}  {reason}" for reason, count in reasons.most_common(MOST_LINES)]
    left = len(reasons) - len(shown)
    return [*shown, f"        and {left} other reasons"] if left else shown


def _listed(lines: Iterable[str]) -> list[str]:
    every: Sequence[str] = list(lines)
    left = len(every) - MOST_LINES
    return [f"  {line}" for line in every[:MOST_LINES]] + ([f"  and {left} more"] if left > 0 else [])
