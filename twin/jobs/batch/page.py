"""``cohort.html``: failures first, then distributions, then a sortable table; one page that needs no network.

How one number is distributed over the cases, as a small picture that the page holds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.batch.merge import NO_SAFE, NOT_RUN
from puncture_twin.planning.search.candidates import ARM_CHECKED
from puncture_twin.planning.search.uncertainty_breakdown import chance_text
from puncture_twin.twin.report.numbers import number
from puncture_twin.twin.report.page.page_tables import inputs_table, table
from puncture_twin.twin.report.page.template import Card, packed, png_address, script_json, write_html

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
WIDTH, HEIGHT, SHARP = 460, 220, 2
"""Of the picture on the page, and how much finer it is, for sharp screens."""


def histogram(values: Sequence[float], text: str) -> Markup:
    """A picture of the count of cases over a number.

    Args:
        values: At least one, finite.
        text: What it is, with its unit.
    """
    from matplotlib.ticker import MaxNLocator  # here: a cohort is searched without it

    from puncture_twin.twin.report.figures import PIXEL_DPI, figure_of, png

    head = f"{text}: {len(values)} case{'s' if len(values) != 1 else ''}, median {_plain(float(np.median(values)))}"
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
    return Markup('<img src="{}" alt="{}" style="width:100%">').format(png_address(png(figure)), head)


def _plain(value: float) -> str:
    """A number without an exponent, to three digits or more."""
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"
