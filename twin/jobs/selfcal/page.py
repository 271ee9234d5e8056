"""``report.html`` of a self-calibration: one page that needs no network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.puncture import Puncture
from puncture_twin.twin.jobs.selfcal.selfcal import SelfcalRun
from puncture_twin.twin.jobs.selfcal.text import NOISE_TEXT, REASON_TEXT, Facts, counted, missed_text, selfcal_facts
from puncture_twin.twin.report.numbers import number
from puncture_twin.twin.report.page.page_tables import TIMES, faint, inputs_table, origin_section, pairs, table
from puncture_twin.twin.report.page.template import Card, curve, data_address, plotly_script, script_json, write_html

COLOURS = ("#0072b2", "#e69f00", "#009e73")
"""Okabe and Ito's blue, orange, green."""

SET_ASIDE = "#d6001e"

IMAGE_AXES = ("residual along u, mm", "residual along v, mm")


def residual_charts(found: Calibration, recording: Recording) -> dict[str, Any]:
    """``residuals``: each pose's three components in the image frame; ``in_image``: the same, v over u."""
    rotated = np.einsum("nji,nj->ni", recording.A[:, :3, :3] @ found.X[:3, :3], found.residuals)
    aside = np.isin(recording.names, found.outliers)
    used = list(np.flatnonzero(~aside))
    names = np.array(recording.names)
    by_pose, in_image = [], []
    for axis, label in enumerate(("u, along the face", "v, into the depth", "across the slice")):
        marks = {"color": COLOURS[axis], "size": 6}
        by_pose.append(curve(label, names[used], _mm(rotated[used, axis]), "markers") | {"marker": marks})
    marks = {"color": COLOURS[0], "size": 7}
    in_image.append(curve("used", _mm(rotated[used, 0]), _mm(rotated[used, 1]), "markers") | {"marker": marks})
    if aside.any():
        marks = {"color": SET_ASIDE, "size": 8, "symbol": "x"}
        for axis in range(3):
            style = {"showlegend": axis == 0, "marker": marks}
            by_pose.append(curve("set aside", names[aside], _mm(rotated[aside, axis]), "markers") | style)
        in_image.append(
            curve("set aside", _mm(rotated[aside, 0]), _mm(rotated[aside, 1]), "markers") | {"marker": marks}
        )
    pose_layout, image_layout = _layout("pose", "residual, mm"), _layout(*IMAGE_AXES)
    pose_layout["xaxis"]["type"] = "category"
    image_layout["yaxis"]["scaleanchor"] = "x"
    return {
        "residuals": {"data": by_pose, "layout": pose_layout},
        "in_image": {"data": in_image, "layout": image_layout},
    }


def puncture_chart(reached: Sequence[Puncture]) -> dict[str, Any]:
    """Error of every target, in the order reached, beside what calibration and reading let expect."""
    x, curves = np.arange(1, len(reached) + 1), []
    parts = (("distance", "error_mm", COLOURS[0]), ("across the needle", "lateral_mm", COLOURS[2]))
    for label, key, colour in parts:
        y = _mm(np.array([getattr(one, key) for one in reached]))
        curves.append(curve(label, x, y, "markers") | {"marker": {"color": colour, "size": 7}})
    expected = _mm(np.array([one.expected_mm for one in reached]))
    line = {"color": "#5b616b", "dash": "dash"}
    curves.append(curve("expected (rms): calibration and reading", x, expected) | {"line": line})
    layout = _layout("target", "true tip to true target, mm")
    layout["yaxis"]["rangemode"] = "tozero"
    return {"data": curves, "layout": layout}


def _mm(values: Any) -> Any:
    return np.round(values, 3)


def _layout(x: str, y: str) -> dict[str, Any]:
    return {
        "height": 360,
        "margin": {"l": 60, "r": 15, "t": 20, "b": 45},
        "xaxis": {"title": {"text": x}},
        "yaxis": {"title": {"text": y}, "zeroline": True, "zerolinecolor": "#999999"},
        "legend": {"orientation": "h", "y": 1.16},
        "plot_bgcolor": "#fbfbfc",
        "paper_bgcolor": "#ffffff",
    }


def write_page(run: SelfcalRun, sheet: Path | None, workcell: Path | None, path: Path) -> Path:
    """Write the page.

    Args:
        run: What was done.
        sheet: The B-mode pictures; None for a recording.
        workcell: The picture of the workcell; None for a recording.
        path: The HTML to write; it appears whole or not at all.
    """
    facts, charts = selfcal_facts(run), residual_charts(run.calibration, run.recording)
    twin = None
    if sheet is not None and workcell is not None and run.trials:
        charts["targets"] = puncture_chart(run.punctures)
        twin = _twin_section(facts, sheet, workcell)
    write_html(
        "selfcal.html",
        path,
        title=f"{run.name}: ultrasound self-calibration",
        cards=_cards(facts),
        cannot=facts["cannot_show"],
        calibration=_calibration(facts, deviations(run.calibration)),
        twin=twin,
        inputs=inputs_table(run.inputs),
        origin=_origin(run),
        data=script_json(charts),
        plotly=plotly_script(),
    )
    return path


def _origin(run: SelfcalRun) -> Markup:
    """Seed and versions; a recording has no seed."""
    if run.trials:
        return origin_section(run.trials[0].seed)
    return pairs([("seed", "none: nothing was drawn")]) + TIMES


def _cards(facts: Facts) -> list[Card]:
    aside, poses = facts["set_aside"], facts["poses"]
    cards = [
        Card(
            "expected error of the calibration",
            number(facts["predicted_tre_mm"], 2, "mm"),
            f"rms at the tip: {counted(facts)}",
        ),
        Card("residuals", number(facts["residual_rms_mm"], 2, "mm"), "rms length of the poses that were used"),
        Card("poses", f"{poses - len(aside)} of {poses}", f"set aside: {', '.join(aside) or 'none'}"),
    ]
    reached = facts["punctures"]
    if reached is not None:
        detail = (
            f"rms over {reached['targets']} targets, worst {number(reached['error_worst_mm'], 2, 'mm')}; calibration, "
            f"arms and reading let expect {number(reached['predicted_with_reading_rms_mm'], 2, 'mm')}"
        )
        cards.insert(0, Card("tip to target, true", number(reached["error_rms_mm"], 2, "mm"), detail))
    return cards


def deviations(found: Calibration) -> dict[str, float]:
    """Standard deviation of every parameter, by name; rotations in degrees."""
    sigma = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
    pairs = zip(found.parameters, sigma, strict=True)
    return {
        name.replace("_rad", "_deg"): float(np.degrees(value) if name.endswith("_rad") else value)
        for name, value in pairs
    }


def _calibration(facts: Facts, sigma: dict[str, float]) -> Markup:
    rows = [
        ("T_end1_image (X), mm", _matrix(facts["T_end1_image"])),
        ("T_base1_base2 (Y), mm", _matrix(facts["T_base1_base2"])),
        ("tip in end2, mm", _vector(facts["tip_end2_mm"], 3)),
        ("needle direction in end2", _vector(facts["needle_direction_end2"], 5)),
        ("iterations", str(facts["iterations"])),
        ("condition σ_min/σ_max, lengths in 100 mm", f"{facts['condition']:.2e}"),
    ]
    if facts["arms"] is not None:
        rows.append(("χ² of the residuals over their freedom", f"{facts['arms']['chi2_per_freedom']:.2f}"))
    rows += [(NOISE_TEXT[key], f"{value:.3f}") for key, value in facts["noise"].items()]
    known = [(name, f"{value:.4f}") for name, value in sigma.items()]
    shown = table(("parameter", "standard deviation"), known, kind="numbers")
    note = faint("w: a small turn, R exp([w]×); t: a shift; V: the needle’s direction.")
    return pairs(rows) + Markup("<h3>How well each number is known</h3>") + shown + note


def _twin_section(facts: Facts, sheet: Path, workcell: Path) -> dict[str, str]:
    counts = [(REASON_TEXT[key], f"{value:,}") for key, value in facts["candidates"].items()]
    choice, recorded, trials = facts["choice"], facts["poses"], facts["trials"]
    bounds = [
        (f"expected error with the {recorded} recorded poses", number(choice["chosen_bound_mm"], 3, "mm")),
        (
            f"{recorded} at random, median of {choice['random_sets']} choices",
            number(choice["random_bound_median_mm"], 3, "mm"),
        ),
        ("at random, the best of them", number(choice["random_bound_best_mm"], 3, "mm")),
    ]
    return {
        "seeds": f"{len(trials)} seed{'s' if len(trials) != 1 else ''}, each a room of its own",
        "punctures": _punctures(facts),
        "trials": _trials(facts),
        "seed": str(trials[0]["seed"]),
        "sheet": data_address(sheet),
        "room": data_address(workcell),
        "counts": table(("what became of a draw", "draws"), counts, kind="numbers"),
        "choice": pairs(bounds) + faint("Cramér-Rao bounds over all candidates."),
    }


def _punctures(facts: Facts) -> Markup:
    reached = facts["punctures"]
    if reached is None:
        return Markup("<p>No target could be reached without touching.</p>")
    rows = [
        ("tip to target, rms", number(reached["error_rms_mm"], 2, "mm")),
        ("median, worst", f"{number(reached['error_median_mm'], 2)}, {number(reached['error_worst_mm'], 2, 'mm')}"),
        ("across the needle, rms", number(reached["lateral_rms_mm"], 2, "mm")),
        (
            "along the needle, mean and rms",
            f"{number(reached['depth_mean_mm'], 2)}, {number(reached['depth_rms_mm'], 2, 'mm')}",
        ),
        ("expected (rms): calibration and arms", number(reached["predicted_rms_mm"], 2, "mm")),
        ("expected (rms): with the target's reading", number(reached["predicted_with_reading_rms_mm"], 2, "mm")),
    ]
    return pairs(rows)


def _trials(facts: Facts) -> Markup:
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
    for values in facts["trials"]:
        along, reached = values["detected_tip_along_mm"], values["punctures"]
        rows.append(
            (
                str(values["seed"]),
                number(values["residual_rms_mm"], 3),
                number(values["predicted_tre_mm"], 3),
                number(values["held_out_error_rms_mm"], 3),
                f"{number(along[0], 2)}, {number(along[1], 2)}",
                number(values["detected_angle_deg"][1], 2),
                missed_text(values),
                ", ".join(values["set_aside"]) or "none",
                str(values["true_contacts"]),
                "–" if reached is None else number(reached["error_rms_mm"], 2),
            )
        )
    note = "Held-out: predicted minus true tip at poses that were not recorded, with what is left of the arms’ errors."
    return table(head, rows, kind="numbers") + faint(note)


def _matrix(T: Any) -> Markup:
    lines = ["  ".join(f"{value:10.5f}" for value in row[:3]) + f"  {row[3]:9.3f}" for row in T[:3]]
    return Markup("<pre>{}</pre>").format("\n".join(lines))


def _vector(values: Any, digits: int) -> str:
    return "(" + ", ".join(f"{value:.{digits}f}" for value in np.asarray(values)) + ")"
