"""``report.html``: everything about a run on one page that needs no network."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from plotly.offline import get_plotlyjs

from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.twin.report.numbers import (
    chosen_row,
    demanding,
    nearest_structure,
    needle_words,
    number,
    target_words,
)
from puncture_twin.twin.report.page import page_tables as tables
from puncture_twin.twin.report.page.page_charts import rehearsal_charts
from puncture_twin.twin.report.page.page_map import map_data
from puncture_twin.twin.report.page.page_scene import scene_figure


def write_page(
    case: Any,
    anatomy: Any,
    candidates: Candidates,
    plan: Any | None,
    rehearsal: Any | None,
    registration: Mapping[str, Any] | None,
    path: Path,
    *,
    film: str | None = None,
) -> None:
    """Write the page.

    Args:
        case: The case.
        anatomy: Structures, skin, warnings.
        candidates: The search's rows.
        plan: The plan, or None.
        rehearsal: What was measured, or None.
        registration: The registration as plain values, or None.
        path: The HTML to write; it appears whole or not at all.
        film: Name of the rehearsal's film, which lies beside the page and is linked; None without one.
    """
    data = {
        "map": map_data(case, candidates),
        "scene": scene_figure(case, anatomy, candidates, plan, user_cache()),
        "charts": None if rehearsal is None else rehearsal_charts(rehearsal, case.target_ct, demanding(anatomy)),
        "target": [float(v) for v in case.target_ct],
        "probe_mm": float(case.needle.length_mm),
    }
    seed = case.rehearsal.seed if plan is None else plan.seed
    parts = {
        "title": tables.escape(f"{case.name}: puncture of {target_words(case)}"),
        "needle": tables.escape(needle_words(case)),
        "verdict": _verdict(candidates, plan, rehearsal),
        "counts": tables.counts_table(candidates),
        "best": tables.best_table(candidates),
        "plan": tables.plan_section(plan),
        "registration": tables.registration_section(registration, plan),
        "rehearsal": tables.rehearsal_section(rehearsal, demanding(anatomy), film),
        "warnings": tables.warnings_section(anatomy.warnings),
        "inputs": tables.inputs_table(case.inputs),
        "origin": tables.origin_section(seed),
        "style": _part("page.css"),
        "data": _json(data),
        "script": _part("page.js"),
        "plotly": get_plotlyjs(),
    }
    text = fill(_part("page.html"), parts)
    with atomic(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")


def fill(template: str, parts: Mapping[str, str]) -> str:
    """Put parts where the template says ``{{name}}``, in one pass: what is put in is never searched again.

    Raises:
        KeyError: The template names a part that is not given.
    """
    pieces = template.split("{{")
    filled = [pieces[0]]
    for piece in pieces[1:]:
        name, _, rest = piece.partition("}}")
        filled += [parts[name], rest]
    return "".join(filled)


def _part(name: str) -> str:
    return (files("puncture_twin.twin.report") / name).read_text(encoding="utf-8")


def _json(data: Any) -> str:
    """JSON that may stand inside a script element: no tag can end it early."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _verdict(candidates: Candidates, plan: Any | None, rehearsal: Any | None) -> str:
    row = chosen_row(candidates)
    safe = int(candidates.safe.sum())
    if safe == 0:
        counts = ", ".join(f"{tables.escape(k.replace('_', ' '))}: {v:,}" for k, v in candidates.counts().items())
        return (
            '<div class="card bad"><h2>Nothing is safe</h2>'
            f"<p>All {len(candidates):,} directions are refused ({counts}).</p></div>"
        )
    cards = [
        (
            "safe directions" if candidates.arm_checked else f"directions {candidates.safe_text}",
            f"{safe:,} of {len(candidates):,}",
            f"{100 * safe / len(candidates):.1f} % of the grid",
        )
    ]
    if row is not None:
        name, clearance = nearest_structure(candidates, row)
        where = f"θ {np.degrees(candidates.theta[row]):g}°, β {np.degrees(candidates.beta[row]):g}°"
        detail = f"{number(float(candidates.path.length[row]), 1, 'mm')} in the body"
        if name:
            detail += f"; nearest {tables.escape(name.replace('_', ' '))}, {number(clearance, 1, 'mm')}"
        cards.append(("best direction", where, detail))
    if not candidates.arm_checked:
        cards.append(("arm", "not checked", tables.escape(candidates.arm_note.removeprefix("not checked: "))))
    if plan is None:
        cards.append(("plan", "none", "the arm's motion was not planned or not found"))
    if rehearsal is not None:
        touched = len(rehearsal.contacts)
        detail = f"{touched} contact{'s' if touched != 1 else ''}" if touched else "no contact"
        expected = f"expected (rms) {number(rehearsal.predicted_error_mm, 2, 'mm')}; {detail}"
        cards.append(("rehearsed tip error", number(rehearsal.tip_error_mm, 2, "mm"), expected))
    return "".join(
        f'<div class="card"><h3>{title}</h3><p class="big">{value}</p><p class="faint">{detail}</p></div>'
        for title, value, detail in cards
    )
