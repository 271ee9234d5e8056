"""What the commands of a cohort show: each one's sections for the terminal, and ``cohort.html``."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.base.text import first_few, plural
from puncture_twin.planning.batch.merge import NO_SAFE, NOT_RUN, CaseChange, Comparison
from puncture_twin.planning.batch.run import CohortState, RunCounts
from puncture_twin.planning.search.candidates import ARM_CHECKED
from puncture_twin.planning.search.uncertainty_breakdown import chance_text
from puncture_twin.twin.report.page.template import Card, packed, script_json
from puncture_twin.twin.report.present import Block, Field, Section, Table, grid, picture, text, write_page
from puncture_twin.twin.report.progress import duration_text

MOST_LINES = 10  # of a list; the rest is counted. ``--json`` has all
MOST_CASES = 5  # named of one reason
STALE = "inputs changed since the plan"
NOW = "for the inputs as planned; batch status lists those that changed since"


def plan_text(run: Any, jobs: int) -> str:
    """How many cases, how many of them are refused or known, and the estimate of a dry run."""
    refused = _listed(f"{one.case}: {one.refusal}" for one in run.refused)
    head = Section(f"{_cases(len(run.cases))}, {run.known} already with a row", refused)
    if run.guess is None:
        plan = Section(f"plan: {run.out / 'plan.parquet'}", [])
        return text([head, plan, Section(f"next: run-twin batch run --out {run.out}", [])])
    if run.guess.sample is None:
        return text([head, Section("nothing to estimate from: no case can be read", [])])
    estimate = run.summary(jobs)["estimate"]
    return text([
        head,
        Section(f"measured at {estimate['sample']}: {estimate['seconds_per_case']:.2f} s per case", []),
        Section(
            f"{plural(jobs, 'worker')}: about {duration_text(estimate['seconds'])}, "
            f"{estimate['memory_mb']} MB of memory, {estimate['disk_mb']:.1f} MB of disk, "
            "if every case is like it; nothing was written", []),
    ])  # fmt: skip


def run_text(out: Path, counts: RunCounts) -> str:
    """What a run did, and what comes next."""
    refused = f" ({counts.refused_before} refused)" if counts.refused_before else ""
    same = f"{counts.same} the same as other cases, " if counts.same else ""
    done = f"{counts.ended[0] + counts.ended[1]} done, {counts.failed} failed"
    stale = [f"{counts.stale} not run: {STALE}; run batch plan again"] if counts.stale else []
    return text([
        Section(f"{_cases(counts.planned)}: {same}{counts.before} already had a row{refused}, {done}",
                [*_reasons(counts.reasons), *stale]),
        Section(f"next: run-twin batch status --out {out}", [f"    run-twin batch merge --out {out}"]),
    ])  # fmt: skip


def state_text(state: CohortState) -> str:
    """Done, failed with reasons, missing, stale."""
    done = f"{state.done:6d}  done ({state.safe} with a safe direction, {state.no_safe} without)"
    failed, missing = f"{state.failed:6d}  failed", f"{state.missing:6d}  missing"
    stale = [f"{state.stale:6d}  stale: {STALE}", *_listed(state.stale_cases)]
    return text([Section(_cases(state.planned), [done, failed, *_reasons(state.reasons), missing, *stale])])


def merge_text(merged: Any) -> str:
    """How many of which kind, the files, and what is not as expected."""
    found = merged.summary()
    kinds = (
        "{safe} with a safe direction, {no_safe} without, {failed} failed ({refused} of them refused), "
        "{not_run} not run"
    ).format(**found, failed=found["refused"] + found["program_failed"])
    changed = merged.changed
    unlike = [] if changed is None else [Section(f"{len(changed)} not as expected", _listed(map(change_line, changed)))]
    wrote = (Section(f"wrote {path}", []) for path in merged.files)
    return text([Section(f"{_cases(found['cases'])}: {kinds}", []), *wrote, Section(NOW, []), *unlike])


def compare_text(found: Comparison) -> str:
    """Per case what changed, and in sum."""
    counts, moved = found.counts, found.moved_mm
    kinds = ", ".join(f"{counts[kind]} {kind}" for kind in sorted(counts))
    far = []
    if moved:
        far = [f"cases that are safe in both: {len(moved)}; their best entries moved by {np.median(moved):.2f} mm "
               f"(median), {max(moved):.2f} mm at most"]  # fmt: skip
    changed = [one for one in found.changes if one.kind != "same" or one.moved_mm]
    return text([Section(f"{_cases(len(found.changes))}: {kinds}", [*far, *_listed(map(change_line, changed))])])


def change_line(change: CaseChange) -> str:
    """One case in two cohorts."""

    def told(row: Any) -> str:
        if row is None:
            return "-"
        return f"{row['safe']} safe" if row["reason"] is None else str(row["reason"])

    moved = "" if change.moved_mm is None else f"; best entry moved {change.moved_mm:.2f} mm"
    more = "" if change.clearance_mm is None else f", clearance {change.clearance_mm:+.3f} mm"
    options = "" if change.options == "{}" else f" {change.options}"
    return f"{change.case}{options}: {change.kind}: {told(change.before)} -> {told(change.after)}{moved}{more}"


def _cases(count: int) -> str:
    return plural(count, "case")


def _reasons(reasons: Counter[str]) -> list[str]:
    return _listed([f"{count:6d}  {reason}" for reason, count in reasons.most_common()], "other reasons")


def _listed(lines: Iterable[str], rest: str = "more") -> list[str]:
    every: Sequence[str] = list(lines)
    left = len(every) - MOST_LINES
    return [*every[:MOST_LINES], *([f"and {left} {rest}"] if left > 0 else [])]


Row = Mapping[str, Any]

DISTRIBUTIONS = (
    ("safe_square_deg", "safe area, deg²"),
    ("best_clearance_mm", "best clearance, mm"),
    ("best_p_hit", "chance to hit, best candidate"),
    ("reach_fraction", "fraction that the arm reaches"),
)
"""Columns whose distribution is drawn, each over the cases that have it."""

OUTCOMES = {1: NO_SAFE, 2: "refused", 3: "the program failed"}  # what a person reads for an exit code
UNDER = "One row per case. cases.parquet, next to this page, has every column; candidates/ has every direction."
REFUSED = "Cases without a verdict, by reason. A refused case states what is wrong with its inputs."
COLUMNS = (
    "Click a column's head to sort by it. θ, β, clearance, path and chance are those of the best candidate; reach "
    "is the fraction of the organ-safe directions that the arm reaches."
)
CASE = (
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
"""A row of the table; a link only to a page that is there."""


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
        """Never "safe" alone where the arm was not checked; why a case has none stands under the failures."""
        if row["exit_code"] == 0:
            return "safe" if row["arm"] == ARM_CHECKED else "safe for the organs"
        return OUTCOMES.get(row["exit_code"], NOT_RUN)

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


BARS = 30
WIDTH, HEIGHT, SHARP = 460, 220, 2  # of the picture on the page, and how much finer it is, for sharp screens


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
