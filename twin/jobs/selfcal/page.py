"""``report.html`` of a self-calibration: one page that needs no network."""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from plotly.offline import get_plotlyjs
from plotly.utils import PlotlyJSONEncoder

from puncture_twin.planning.base.files import atomic
from puncture_twin.twin.guidance.ultrasound.summaries import (
    noise_summary,
    predicted_tre,
    puncture_summary,
    trial_summary,
)
from puncture_twin.twin.jobs.selfcal.page_charts import puncture_chart, residual_charts
from puncture_twin.twin.jobs.selfcal.selfcal import SelfcalRun
from puncture_twin.twin.jobs.selfcal.text import NOISE_WORDS, REASON_WORDS, deviations
from puncture_twin.twin.report.numbers import number
from puncture_twin.twin.report.page.page import fill
from puncture_twin.twin.report.page.page_tables import TIMES, escape, inputs_table, origin_section, pairs, table

TEMPLATE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob:;
 style-src 'unsafe-inline'; img-src data: blob:; font-src data:; worker-src blob:">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{{title}}</title>
<style>{{style}} img.wide {max-width: 100%; height: auto;}</style>
</head>
<body>
<header>
<h1>{{title}}</h1>
<p class="faint">A X p = Y B q: X probe flange to image, Y base 1 to base 2, q the tip in the needle's flange frame.
Research software, not a medical device.</p>
</header>
<section class="cards">{{cards}}</section>
<h2>What the data cannot show</h2>
{{cannot}}
<h2>Calibration</h2>
{{calibration}}
<h2>Residuals</h2>
<p class="faint">Y B q − A X p of every pose, in the axes of the image. Small residuals do not prove a small error at a
target.</p>
<div class="two"><div id="residuals"></div><div id="in_image"></div></div>
{{twin}}
<h2>Inputs</h2>
{{inputs}}
<h2>Versions and seed</h2>
{{origin}}
<script type="application/json" id="data">{{data}}</script>
<script>{{plotly}}</script>
<script>
"use strict";
for (const [id, figure] of Object.entries(JSON.parse(document.getElementById("data").textContent))) {
  Plotly.newPlot(id, figure.data, figure.layout, { displaylogo: false, responsive: true });
}
</script>
</body>
</html>
"""

TWIN = """
<h2>The needle sent to targets seen in the image</h2>
<p class="faint">In the twin, with the true arms: the target is read off the image (with the reading's error), the
needle's arm goes where the calibration says. Targets were not recorded before; {{seeds}}.</p>
{{punctures}}
<div id="targets"></div>
<h2>Seeds</h2>
{{trials}}
<h2>B-mode pictures</h2>
<p class="faint">Of seed {{seed}}. The detector sees the grey picture alone.</p>
<img class="wide" alt="B-mode pictures with detected and true tips" src="data:image/png;base64,{{sheet}}">
<h2>The room</h2>
<img class="wide" alt="Both arms about the phantom" src="data:image/png;base64,{{room}}">
<p class="faint">One recorded pose, by the drawing. The needle is drawn 3 mm thick; blue: the slice that the image
shows.</p>
<h2>Poses</h2>
<div class="two"><div>{{counts}}</div><div>{{choice}}</div></div>
"""


def write_page(run: SelfcalRun, sheet: Path | None, room: Path | None, path: Path) -> Path:
    """Write the page.

    Args:
        run: What was done.
        sheet: The B-mode pictures; None for a recording.
        room: The picture of the room; None for a recording.
        path: The HTML to write; it appears whole or not at all.
    """
    charts = residual_charts(run.calibration, run.recording)
    twin = ""
    if sheet is not None and room is not None and run.trials:
        charts["targets"] = puncture_chart(run.punctures)
        twin = _twin_section(run, sheet, room)
    parts = {
        "title": escape(f"{run.name}: ultrasound self-calibration"),
        "style": (files("puncture_twin.twin.report") / "page.css").read_text(encoding="utf-8"),
        "cards": _cards(run),
        "cannot": "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in run.calibration.cannot_show) + "</ul>",
        "calibration": _calibration(run),
        "twin": twin,
        "inputs": inputs_table(run.inputs),
        "origin": _origin(run),
        "data": json.dumps(charts, cls=PlotlyJSONEncoder, allow_nan=False).replace("<", "\\u003c"),
        "plotly": get_plotlyjs(),
    }
    with atomic(path) as temporary:
        temporary.write_text(fill(TEMPLATE, parts), encoding="utf-8")
    return path


def _origin(run: SelfcalRun) -> str:
    """Seed and versions; a recording has no seed."""
    if run.trials:
        return origin_section(run.trials[0].seed)
    return pairs([("seed", "none: nothing was drawn")]) + TIMES


def _cards(run: SelfcalRun) -> str:
    found = run.calibration
    used = len(run.recording) - len(found.outliers)
    cards = [
        ("expected error of the calibration", number(predicted_tre(found, run.recording), 2, "mm"), "rms at the tip"),
        ("residuals", number(found.rms_mm, 2, "mm"), "rms length of the poses that were used"),
        ("poses", f"{used} of {len(run.recording)}", f"set aside: {', '.join(found.outliers) or 'none'}"),
    ]
    reached = puncture_summary(run.punctures)
    if reached is not None:
        detail = (
            f"rms over {reached['targets']} targets, worst {number(reached['error_worst_mm'], 2, 'mm')}; calibration "
            f"and reading let expect {number(reached['predicted_with_reading_rms_mm'], 2, 'mm')}"
        )
        cards.insert(0, ("tip to target, true", number(reached["error_rms_mm"], 2, "mm"), detail))
    return "".join(
        f'<div class="card"><h3>{escape(title)}</h3><p class="big">{escape(value)}</p>'
        f'<p class="faint">{escape(detail)}</p></div>'
        for title, value, detail in cards
    )


def _calibration(run: SelfcalRun) -> str:
    found = run.calibration
    sigma = deviations(found)
    rows = [
        ("T_end1_image (X), mm", _matrix(found.X)),
        ("T_base1_base2 (Y), mm", _matrix(found.Y)),
        ("tip in end2, mm", escape(_vector(found.tip_end2, 3))),
        ("needle direction in end2", escape(_vector(found.needle_direction_end2, 5))),
        ("iterations", str(found.iterations)),
        ("condition σ_min/σ_max, lengths in 100 mm", f"{found.condition:.2e}"),
    ]
    rows += [(NOISE_WORDS[key], f"{value:.3f}") for key, value in noise_summary(found).items()]
    known = [(escape(name), f"{value:.4f}") for name, value in sigma.items()]
    shown = table(("parameter", "standard deviation"), known, kind="numbers")
    note = '<p class="faint">w: a small turn, R exp([w]×); t: a shift; V: the needle’s direction.</p>'
    return f"{pairs(rows)}<h3>How well each number is known</h3>{shown}{note}"


def _twin_section(run: SelfcalRun, sheet: Path, room: Path) -> str:
    assert run.candidates is not None  # there are no trials without
    assert run.choice is not None
    counts = [(escape(REASON_WORDS[key]), f"{value:,}") for key, value in run.candidates.counts.items()]
    choice = run.choice
    asked = len(run.recording)
    bounds = [
        (f"expected error with the {asked} recorded poses", number(choice.chosen_mm, 3, "mm")),
        (f"{asked} at random, median of {len(choice.random_mm)} choices", number(choice.median_random_mm, 3, "mm")),
        ("at random, the best of them", number(min(choice.random_mm), 3, "mm")),
    ]
    seeds = f"{len(run.trials)} seed{'s' if len(run.trials) != 1 else ''}, each a room of its own"
    parts = {
        "seeds": seeds,
        "punctures": _punctures(run),
        "trials": _trials(run),
        "seed": str(run.trials[0].seed),
        "sheet": _encoded(sheet),
        "room": _encoded(room),
        "counts": table(("what became of a draw", "draws"), counts, kind="numbers"),
        "choice": pairs(bounds) + '<p class="faint">Cramér-Rao bounds over all candidates.</p>',
    }
    return fill(TWIN, parts)


def _punctures(run: SelfcalRun) -> str:
    reached = puncture_summary(run.punctures)
    if reached is None:
        return "<p>No target could be reached without touching.</p>"
    rows = [
        ("tip to target, rms", number(reached["error_rms_mm"], 2, "mm")),
        ("median, worst", f"{number(reached['error_median_mm'], 2)}, {number(reached['error_worst_mm'], 2, 'mm')}"),
        ("across the needle, rms", number(reached["lateral_rms_mm"], 2, "mm")),
        (
            "along the needle, mean and rms",
            f"{number(reached['depth_mean_mm'], 2)}, {number(reached['depth_rms_mm'], 2, 'mm')}",
        ),
        ("expected (rms): calibration alone", number(reached["predicted_rms_mm"], 2, "mm")),
        ("expected (rms): with the target's reading", number(reached["predicted_with_reading_rms_mm"], 2, "mm")),
    ]
    return pairs(rows) + '<p class="faint">The arms’ own errors come on top of what is expected.</p>'


def _trials(run: SelfcalRun) -> str:
    head = (
        "seed",
        "residual rms mm",
        "expected error mm",
        "held-out tip error rms mm",
        "tip found: mean, sd along mm",
        "angle sd °",
        "not used",
        "set aside",
        "true contacts of the arms",
        "tip to target rms mm",
    )
    rows = []
    for trial in run.trials:
        values: dict[str, Any] = trial_summary(trial)
        along, reached = values["detected_tip_along_mm"], values["punctures"]
        rows.append(
            (
                str(trial.seed),
                number(values["residual_rms_mm"], 3),
                number(values["predicted_tre_mm"], 3),
                number(values["held_out_error_rms_mm"], 3),
                f"{number(along[0], 2)}, {number(along[1], 2)}",
                number(values["detected_angle_deg"][1], 2),
                escape("; ".join(f"{count} {reason}" for reason, count in values["missed"].items()) or "none"),
                escape(", ".join(values["set_aside"]) or "none"),
                str(values["true_contacts"]),
                "–" if reached is None else number(reached["error_rms_mm"], 2),
            )
        )
    note = "Held-out: predicted minus true tip at poses that were not recorded, with both arms’ errors in it."
    return table(head, rows, kind="numbers") + f'<p class="faint">{note}</p>'


def _matrix(T: Any) -> str:
    lines = ["  ".join(f"{value:10.5f}" for value in row[:3]) + f"  {row[3]:9.3f}" for row in T[:3]]
    return "<pre>" + escape("\n".join(lines)) + "</pre>"


def _vector(values: Any, digits: int) -> str:
    return "(" + ", ".join(f"{value:.{digits}f}" for value in np.asarray(values)) + ")"


def _encoded(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode("ascii")
