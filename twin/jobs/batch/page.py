"""``cohort.html``: failures first, then distributions, then a sortable table; one page that needs no network.

How one number is distributed over the cases, as a small picture of lines and text that a page holds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.batch.merge import NO_SAFE, NOT_RUN
from puncture_twin.planning.search.candidates import ARM_CHECKED
from puncture_twin.planning.search.uncertainty_breakdown import chance_text
from puncture_twin.twin.report.numbers import number
from puncture_twin.twin.report.page.page_tables import inputs_table, joined, table
from puncture_twin.twin.report.page.template import Card, packed, script_json, write_html

Row = Mapping[str, Any]

DISTRIBUTIONS = (
    ("safe_square_deg", "safe area, deg²"),
    ("best_clearance_mm", "best clearance, mm"),
    ("best_p_hit", "chance to hit, best candidate"),
    ("reach_fraction", "fraction that the arm reaches"),
)
"""Columns whose distribution is drawn, each over the cases that have it."""

HEAD = (
    "case",
    "name",
    "verdict",
    "safe",
    "of",
    "θ °",
    "β °",
    "clearance mm",
    "path mm",
    "p hit",
    "area deg²",
    "skin cm²",
    "reach",
    "page",
)


OUTCOMES = {1: NO_SAFE, 2: "refused", 3: "the program failed"}
"""What a person reads for an exit code."""


def write_cohort_page(name: str, rows: Sequence[Row], inputs: Sequence[Input], path: Path) -> None:
    """Write the page.

    Args:
        name: Of the cohort's folder.
        rows: Of ``cases.parquet``.
        inputs: What the table was made from.
        path: The HTML to write; it appears whole or not at all.
    """
    write_html(
        "cohort.html",
        path,
        title=f"Cohort {name}",
        cards=_cards(rows),
        failures=_failures(rows),
        charts=[histogram(_values(rows, column), text) for column, text in DISTRIBUTIONS if _values(rows, column)],
        cases=table(HEAD, map(_line, rows), kind="numbers sortable"),
        inputs=inputs_table(inputs),
        data=script_json({}),
        plotly=packed(""),
    )


def _cards(rows: Sequence[Row]) -> list[Card]:
    codes = Counter(row["exit_code"] for row in rows)
    failed = codes[2] + codes[3] + codes[None]
    return [
        Card("cases", f"{len(rows):,}", "of the plan"),
        Card("with a safe direction", f"{codes[0]:,}", _part(codes[0], len(rows))),
        Card("without one", f"{codes[1]:,}", _part(codes[1], len(rows))),
        Card("failed", f"{failed:,}", f"{codes[2]} refused, {codes[3]} by the program, {codes[None]} not run"),
    ]


def _part(count: int, of: int) -> str:
    return f"{count / of:.1%} of all" if of else "of none"


def _failures(rows: Sequence[Row]) -> Markup:
    """Every reason, most frequent first, with its cases."""
    failed = [row for row in rows if row["exit_code"] not in (0, 1)]
    if not failed:
        return Markup("<p>None.</p>")
    counts = Counter(str(row["reason"]) for row in failed)
    lines = [(str(count), reason, _cases_of(failed, reason)) for reason, count in counts.most_common()]
    return table(("cases", "reason", "which"), lines)


MOST_CASES = 5
"""Named of one reason."""


def _cases_of(rows: Iterable[Row], reason: str) -> str:
    names = [str(row["case"]) for row in rows if row["reason"] == reason]
    more = f" and {len(names) - MOST_CASES} more" if len(names) > MOST_CASES else ""
    return ", ".join(names[:MOST_CASES]) + more


def _values(rows: Sequence[Row], column: str) -> list[float]:
    return [row[column] for row in rows if row[column] is not None]


def _line(row: Row) -> tuple[str, ...]:
    """A row of the table; a link only to a page that is there."""
    page = Markup('<a href="{}/report.html">page</a>').format(row["id"]) if row["page"] else "–"
    return (
        str(row["case"]),
        str(row["name"]),
        _verdict(row),
        _shown(row["safe"], 0),
        _shown(row["directions"], 0),
        _shown(row["best_theta_deg"], 1),
        _shown(row["best_beta_deg"], 1),
        _shown(row["best_clearance_mm"], 2),
        _shown(row["best_path_length_mm"], 1),
        "–" if row["best_p_hit"] is None else chance_text(row["best_p_hit"]),
        _shown(row["safe_square_deg"], 0),
        _shown(row["safe_entry_cm2"], 1),
        _shown(row["reach_fraction"], 2),
        page,
    )


def _verdict(row: Row) -> str:
    """Never "safe" alone where the arm was not checked; why a case has none stands under the failures."""
    if row["exit_code"] == 0:
        return "safe" if row["arm"] == ARM_CHECKED else "safe for the organs"
    return OUTCOMES.get(row["exit_code"], NOT_RUN)


def _shown(value: float | None, digits: int) -> str:
    return "–" if value is None else number(float(value), digits)


BARS = 30
WIDTH, HEIGHT, LEFT, TOP, BOTTOM = 460, 220, 46, 34, 36
"""Of the picture and its edges, in its own units."""


def histogram(values: Sequence[float], text: str) -> Markup:
    """An SVG with the count of cases over a number.

    Args:
        values: At least one, finite.
        text: What it is, with its unit.
    """
    counts, edges = np.histogram(np.asarray(values, dtype=np.float64), BARS)
    head = f"{text}: {len(values)} case{'s' if len(values) != 1 else ''}, median {_plain(float(np.median(values)))}"
    bars = joined(
        '<rect x="{}" y="{}" width="{}" height="{}" fill="#00684a"><title>{}</title></rect>', _bars(counts, edges)
    )
    form = (
        '<svg viewBox="0 0 {} {}" role="img" aria-label="{}"><text x="{}" y="18" font-weight="600">{}</text>{}{}</svg>'
    )
    return Markup(form).format(WIDTH, HEIGHT, head, LEFT, head, _axes(int(counts.max()), edges), bars)


def _plain(value: float) -> str:
    """A number without an exponent, to three digits or more."""
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def _bars(counts: np.ndarray, edges: np.ndarray) -> Iterator[tuple[str, ...]]:
    step, high = (WIDTH - LEFT) / BARS, HEIGHT - TOP - BOTTOM
    for bar, count in enumerate(counts):
        tall = high * count / counts.max()
        label = f"{_plain(edges[bar])} to {_plain(edges[bar + 1])}: {count}"
        left, top = LEFT + bar * step + 0.5, HEIGHT - BOTTOM - tall
        yield f"{left:.1f}", f"{top:.1f}", f"{step - 1:.1f}", f"{tall:.1f}", label


def _axes(most: int, edges: np.ndarray) -> Markup:
    """The base line with three numbers, and the greatest count."""
    base = HEIGHT - BOTTOM
    line = Markup('<line x1="{}" y1="{}" x2="{}" y2="{}" stroke="#5b616b"/>').format(LEFT, base, WIDTH, base)
    middle = (edges[0] + edges[-1]) / 2
    marks = [
        (LEFT, base + 18, "start", _plain(edges[0])),
        ((LEFT + WIDTH) // 2, base + 18, "middle", _plain(middle)),
        (WIDTH, base + 18, "end", _plain(edges[-1])),
        (LEFT - 6, TOP + 10, "end", str(most)),
        (LEFT - 6, base, "end", "0"),
    ]
    cells = ((str(x), str(y), anchor, text) for x, y, anchor, text in marks)
    return line + joined('<text x="{}" y="{}" text-anchor="{}" fill="#5b616b">{}</text>', cells)
