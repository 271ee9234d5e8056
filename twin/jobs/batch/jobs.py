"""``batch plan``, ``batch run`` and ``batch merge``: a cohort's inputs listed, run in parts, and made one table.

And what these commands show: each one's sections for the terminal, and ``cohort.html``.
"""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from puncture_twin.planning.base.errors import require_extra
from puncture_twin.planning.base.output.manifest import MANIFEST_NAME
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.base.text import Shown, first_few, plural
from puncture_twin.planning.batch import merge, plan, run
from puncture_twin.planning.batch.cohort import read_cohort
from puncture_twin.planning.batch.run_case import Limits
from puncture_twin.planning.search.candidates import ARM_CHECKED, Candidates
from puncture_twin.planning.search.uncertainty_breakdown import chance_text
from puncture_twin.twin.report.page.template import packed, script_json
from puncture_twin.twin.report.present import Block, Card, Field, Section, Table, grid, picture, text, write_page
from puncture_twin.twin.report.progress import duration_text

if TYPE_CHECKING:
    from puncture_twin.planning.search.context import CaseContext

PLAN_ENTRY = "batch plan"  # of the folder's manifest
PAGE_NAME = "cohort.html"
MERGE_ENTRY = "batch merge"  # of the folder's manifest
CODES = {"safe": 0, "no_safe": 1, "refused": 2, "program_failed": 3, "not_run": None}  # what a row's exit code means
MOST_LINES = 10  # of a list; the rest is counted. ``--json`` has all
MOST_CASES = 5  # named of one reason
STALE = "inputs changed since the plan"
NOW = "for the inputs as planned; batch status lists those that changed since"
BARS = 30  # of a histogram
WIDTH, HEIGHT, SHARP = 460, 220, 2  # of the picture on the page, and how much finer it is, for sharp screens


@dataclass(frozen=True)
class PlanRun:
    """A cohort's plan, how many cases have a row already, and of a dry run alone how long all will take."""

    cases: tuple[plan.PlannedCase, ...]
    out: Path
    known: int
    guess: run.Estimate | None = None

    @property
    def refused(self) -> list[plan.PlannedCase]:
        """Cases that cannot be read; each gets a row with its reason."""
        return [one for one in self.cases if one.refusal]

    def summary(self, jobs: int) -> dict[str, Any]:
        """Plain values for JSON."""
        document: dict[str, Any] = {
            "cases": len(self.cases),
            "refused": [{"case": one.case, "reason": one.refusal} for one in self.refused],
            "known": self.known,
            "files": [] if self.guess else [str(self.out / plan.PLAN_NAME)],
        }
        if (guess := self.guess) is not None:
            document["estimate"] = {
                "sample": guess.sample,
                "seconds_per_case": round(guess.seconds, 3),
                "seconds": round(guess.seconds * (guess.cases - guess.refused) / jobs, 1),
                "memory_mb": round(guess.memory_bytes * jobs / 1e6),
                "disk_mb": round(guess.disk_bytes / 1e6, 1),
            }
        return document


def plan_cohort(cohort: Path, out: Path, *, arm: bool | None, dry: bool, watcher: Watcher) -> PlanRun:
    """Read every case of a cohort and write ``plan.parquet``; a dry run measures one case and writes nothing."""
    listed, inputs = read_cohort(cohort)
    rows: list[plan.PlannedCase] = []
    for row in plan.planned(listed, arm):
        rows.append(row)
        watcher.count("cases", len(rows), len(listed))
    known = sum(plan.read_row(out, one) is not None for one in {row.id for row in rows}) if out.is_dir() else 0
    if dry:
        return PlanRun(tuple(rows), out, known, run.estimate(rows))
    with writing(out, PLAN_ENTRY, inputs=inputs, names=[plan.PLAN_NAME], note=watcher.note) as draft:
        plan.write_plan_table(rows, draft.folder / plan.PLAN_NAME)
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
    from puncture_twin.twin.jobs.patient.run import Run

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


@dataclass(frozen=True, repr=False)
class Merged(Shown):
    """A merged cohort, its files, and the cases that differ from expected ones, None where none were given."""

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
    listed = plan.read_plan_table(out)
    expected = None if expect is None else merge.read_cases(expect)
    inputs, made_from = [Input("plan", plan.PLAN_NAME, listed.sha256)], {plan.PLAN_NAME: listed.sha256}
    names = [merge.CASES_NAME, PAGE_NAME]
    with writing(out, MERGE_ENTRY, inputs=inputs, names=names, made_from=made_from, note=watcher.note) as draft:
        rows = merge.merged_rows(listed.cases, out)
        merge.write_cases(rows, draft.folder / merge.CASES_NAME)
        merge.write_dataset(rows, out, draft.folder / merge.DATASET_NAME, partial(watcher.count, "tables"))
        write_cohort_page(out.absolute().name, rows, inputs, draft.folder / PAGE_NAME)
    files = tuple(out / name for name in (merge.CASES_NAME, merge.DATASET_NAME, PAGE_NAME, MANIFEST_NAME))
    changed = None if expected is None else tuple(merge.compare(expected, rows).beyond(tolerance_mm))
    return Merged(rows, files, changed)


def plan_text(done: PlanRun, jobs: int) -> str:
    """Text of a plan: how many cases, how many are refused or known, and the estimate of a dry run."""
    refused = _listed(f"{one.case}: {one.refusal}" for one in done.refused)
    head = Section(f"{_cases(len(done.cases))}, {done.known} already with a row", refused)
    if done.guess is None:
        written, after = f"plan: {done.out / 'plan.parquet'}", f"next: run-twin batch run --out {done.out}"
        return text([head, Section(written, []), Section(after, [])])
    if done.guess.sample is None:
        return text([head, Section("nothing to estimate from: no case can be read", [])])
    estimate = done.summary(jobs)["estimate"]
    return text([
        head,
        Section(f"measured at {estimate['sample']}: {estimate['seconds_per_case']:.2f} s per case", []),
        Section(
            f"{plural(jobs, 'worker')}: about {duration_text(estimate['seconds'])}, "
            f"{estimate['memory_mb']} MB of memory, {estimate['disk_mb']:.1f} MB of disk, "
            "if every case is like it; nothing was written", []),
    ])  # fmt: skip


def run_text(out: Path, counts: run.RunCounts) -> str:
    """Text of a run's counts, and the next command."""
    refused = f" ({counts.refused_before} refused)" if counts.refused_before else ""
    same = f"{counts.same} the same as other cases, " if counts.same else ""
    done = f"{counts.ended[0] + counts.ended[1]} done, {counts.failed} failed"
    stale = [f"{counts.stale} not run: {STALE}; run batch plan again"] if counts.stale else []
    return text([
        Section(f"{_cases(counts.planned)}: {same}{counts.before} already had a row{refused}, {done}",
                [*_reasons(counts.reasons), *stale]),
        Section(f"next: run-twin batch status --out {out}", [f"    run-twin batch merge --out {out}"]),
    ])  # fmt: skip


def state_text(state: run.CohortState) -> str:
    """Text of a cohort's cases: done, failed with reasons, missing, stale."""
    done = f"{state.done:6d}  done ({state.safe} with a safe direction, {state.no_safe} without)"
    failed, missing = f"{state.failed:6d}  failed", f"{state.missing:6d}  missing"
    stale = [f"{state.stale:6d}  stale: {STALE}", *_listed(state.stale_cases)]
    return text([Section(_cases(state.planned), [done, failed, *_reasons(state.reasons), missing, *stale])])


def merge_text(merged: Merged) -> str:
    """Text of a merged cohort: cases of each kind, the files, and what is not as expected."""
    summary = merged.summary()
    kinds = (
        "{safe} with a safe direction, {no_safe} without, {failed} failed ({refused} of them refused), "
        "{not_run} not run"
    ).format(**summary, failed=summary["refused"] + summary["program_failed"])
    changed = merged.changed
    unlike = [] if changed is None else [Section(f"{len(changed)} not as expected", _listed(map(change_line, changed)))]
    wrote = (Section(f"wrote {path}", []) for path in merged.files)
    return text([Section(f"{_cases(summary['cases'])}: {kinds}", []), *wrote, Section(NOW, []), *unlike])


def compare_text(comparison: merge.Comparison) -> str:
    """Text of a comparison: the change of each case, and all in sum."""
    counts, moved_mm = comparison.counts, comparison.moved_mm
    kinds = ", ".join(f"{counts[kind]} {kind}" for kind in sorted(counts))
    far = []
    if moved_mm:
        far = [f"cases that are safe in both: {len(moved_mm)}; their best entries moved by {np.median(moved_mm):.2f} "
               f"mm (median), {max(moved_mm):.2f} mm at most"]  # fmt: skip
    changed = [one for one in comparison.changes if one.kind != "same" or one.moved_mm]
    return text([Section(f"{_cases(len(comparison.changes))}: {kinds}", [*far, *_listed(map(change_line, changed))])])


def change_line(change: merge.CaseChange) -> str:
    """Line of one case in two cohorts."""

    def outcome(row: Any) -> str:
        if row is None:
            return "-"
        return f"{row['safe']} safe" if row["reason"] is None else str(row["reason"])

    moved = "" if change.moved_mm is None else f"; best entry moved {change.moved_mm:.2f} mm"
    more = "" if change.clearance_mm is None else f", clearance {change.clearance_mm:+.3f} mm"
    options = "" if change.options == "{}" else f" {change.options}"
    return f"{change.case}{options}: {change.kind}: {outcome(change.before)} -> {outcome(change.after)}{moved}{more}"


def _cases(count: int) -> str:
    return plural(count, "case")


def _reasons(reasons: Counter[str]) -> list[str]:
    return _listed([f"{count:6d}  {reason}" for reason, count in reasons.most_common()], "other reasons")


def _listed(lines: Iterable[str], rest: str = "more") -> list[str]:
    every: Sequence[str] = list(lines)
    left = len(every) - MOST_LINES
    return [*every[:MOST_LINES], *([f"and {left} {rest}"] if left > 0 else [])]


Row = Mapping[str, Any]

DISTRIBUTIONS = (  # columns whose distribution is drawn, each over the cases that have it
    ("safe_square_deg", "safe area, deg²"),
    ("best_clearance_mm", "best clearance, mm"),
    ("best_p_hit", "chance to hit, best candidate"),
    ("reach_fraction", "fraction that the arm reaches"),
)

OUTCOMES = {1: merge.NO_SAFE, 2: "refused", 3: "the program failed"}  # what a person reads for an exit code
UNDER = "One row per case. cases.parquet, next to this page, has every column; candidates/ has every direction."
REFUSED = "Cases without a verdict, by reason. A refused case states what is wrong with its inputs."
COLUMNS = (
    "Click a column's head to sort by it. θ, β, clearance, path and chance are those of the best candidate; reach "
    "is the fraction of the organ-safe directions that the arm reaches."
)
CASE = (  # a row of the table; a link only to a page that is there
    Field("case", "case"),
    Field("name", "name"),
    Field("verdict", "verdict"),
    Field("safe", "safe", 0),
    Field("of", "directions", 0),
    Field("θ °", "best_theta_deg", 1),
    Field("β °", "best_beta_deg", 1),
    Field("clearance mm", "best_clearance_mm", 2),
    Field("path mm", "best_path_length_mm", 1),
    Field("p hit", lambda row: None if row["best_p_hit"] is None else chance_text(row["best_p_hit"])),
    Field("area deg²", "safe_square_deg", 0),
    Field("skin cm²", "safe_entry_cm2", 1),
    Field("reach", "reach_fraction", 2),
    Field("page", lambda row: Markup('<a href="{}/report.html">page</a>').format(row["id"]) if row["page"] else None),
)


def write_cohort_page(name: str, rows: Sequence[Row], inputs: Sequence[Input], path: Path) -> None:
    """Write the page: failures first, then distributions, then a sortable table."""
    codes = Counter(row["exit_code"] for row in rows)
    failed = codes[2] + codes[3] + codes[None]
    shares = [f"{codes[code] / len(rows):.1%} of all" if rows else "of none" for code in (0, 1)]
    cards = [
        Card("cases", f"{len(rows):,}", "of the plan"),
        Card("with a safe direction", f"{codes[0]:,}", shares[0]),
        Card("without one", f"{codes[1]:,}", shares[1]),
        Card("failed", f"{failed:,}", f"{codes[2]} refused, {codes[3]} failed in the program, {codes[None]} not run"),
    ]

    def verdict(row: Row) -> str:
        """Verdict of a case: never "safe" alone where the arm was not checked; failures say why a case has none."""
        if row["exit_code"] == 0:
            return "safe" if row["arm"] == ARM_CHECKED else "safe for the organs"
        return OUTCOMES.get(row["exit_code"], merge.NOT_RUN)

    known = ((said, [row[name] for row in rows if row[name] is not None]) for name, said in DISTRIBUTIONS)
    charts = tuple(histogram(values, said) for said, values in known if values)
    shown = [
        Section("failures", [REFUSED, _failures(rows)]),
        Section("distributions", [charts] if charts else ["No case has a verdict."]),
        Section("cases", [COLUMNS, grid(CASE, [{**row, "verdict": verdict(row)} for row in rows], "numbers sortable")]),
    ]
    scripts = {"data": script_json({}), "plotly": packed(""), "script": "sortable.js"}
    write_page(path, f"Cohort {name}", UNDER, cards, shown, inputs, **scripts)


def _failures(rows: Sequence[Row]) -> Block:
    cases = defaultdict[str, list[str]](list)
    for row in rows:
        if row["exit_code"] not in (0, 1):
            cases[str(row["reason"])].append(str(row["case"]))
    by_count = sorted(cases.items(), key=lambda item: -len(item[1]))
    lines = tuple((str(len(named)), reason, first_few(named, MOST_CASES)) for reason, named in by_count)
    return Table(("cases", "reason", "which"), lines, "") if lines else Markup("<p>None.</p>")


def histogram(values: Sequence[float], text: str) -> Markup:
    """A picture of the count of cases over a number."""
    from matplotlib.ticker import MaxNLocator  # here: a cohort is searched without it

    from puncture_twin.twin.report.figures import PIXEL_DPI, figure_of, png

    middle = float(np.median(values))
    shown = f"{middle:,.0f}" if abs(middle) >= 1000.0 else f"{middle:.3g}"  # no exponent, three digits or more
    head = f"{text}: {_cases(len(values))}, median {shown}"
    figure = figure_of(WIDTH * SHARP, HEIGHT * SHARP, dpi=PIXEL_DPI * SHARP)
    axes = figure.add_axes((0.1, 0.19, 0.87, 0.68))
    axes.hist(values, BARS, color="#00684a", rwidth=0.92)
    axes.set_title(head, fontsize=11, weight="bold", loc="left")
    axes.set_xlabel(text, fontsize=10)
    axes.set_ylabel("cases", fontsize=10)
    axes.tick_params(labelsize=9)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.ticklabel_format(style="plain", useOffset=False)
    axes.spines[["top", "right"]].set_visible(False)
    return picture(png(figure), head)
