"""The part of a servo's page about the needle: its predicted pose against the anatomy beside what came of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from puncture_twin.planning.search.doubt import chance_text
from puncture_twin.twin.jobs.servo.facts import NO_TOUCH
from puncture_twin.twin.jobs.servo.text import DOUBTED, NOT_MODELLED, PHASE_TEXT
from puncture_twin.twin.report.page.page_tables import faint, table

TARGET_HEAD = (
    "target", "expected, mm", "95 % half axes, mm", "lateral, mm", "depth, mm", "direction, °", "chance to hit",
    "realised, mm",
)  # fmt: skip


def needle_section(needle: Mapping[str, Any], first: Mapping[str, Any]) -> Markup:
    """Both tables: over all seeds by each way, and the needles of the first seed after the servo.

    Args:
        needle: Of the facts, over all seeds.
        first: The session that is shown in full.
    """
    columns = [needle[phase] for phase in PHASE_TEXT]
    rows = [(label, *(_cell(one, keys) for one in columns)) for label, keys in _rows(needle["hit_radius_mm"])]
    all_seeds = table(("realised / predicted", *PHASE_TEXT.values()), rows, kind="numbers")
    each = table(TARGET_HEAD, [_needle(row) for row in first["targets"]], kind="numbers")
    return all_seeds + faint(" ".join(_reserves(needle))) + each


def _rows(radius_mm: float | None) -> list[tuple[str, tuple[str, str]]]:
    hit = [] if radius_mm is None else [(f"hit, within {radius_mm:g} mm", ("hit_share", "mean_p_hit"))]
    return [
        ("tip error, rms, mm", ("realised_rms_mm", "predicted_rms_mm")),
        ("direction, rms, °", ("realised_direction_deg", "predicted_direction_deg")),
        ("inside of the 95 % ellipsoid", ("coverage_95", "")),
        *hit,
    ]


def _cell(one: Mapping[str, Any] | None, keys: tuple[str, str]) -> str:
    if one is None:
        return "unknown"
    realised, predicted = one[keys[0]], one.get(keys[1], 0.95)
    if keys[0].endswith(("_mm", "_deg")):
        return f"{realised:.3f} / {predicted:.3f}"
    return f"{100 * realised:.1f} / {100 * predicted:.1f} %"


def _reserves(needle: Mapping[str, Any]) -> list[str]:
    """What a reader must know before believing the table."""
    said = ["The needles of one seed share its room: seeds count, not needles."]
    if needle["wrong_belief"]:
        said.append("The rooms were drawn from [rehearsal.errors]: the belief is wrong by design.")
    test = needle["declaration"]
    if test is not None and test["p"] < DOUBTED:
        said.append(f"What was measured lies farther apart than the declared errors make it (p = {test['p']:.1g}).")
    return [*said, f"Chance to touch: {NO_TOUCH}.", f"Not modelled: {NOT_MODELLED}."]


def _needle(row: Mapping[str, Any]) -> tuple[str, ...]:
    one = row["needle_servoed"]
    if one is None:
        return (row["target"], "unknown", *[""] * (len(TARGET_HEAD) - 2))
    numbers = [one[key] for key in ("lateral_mm", "depth_mm", "predicted_direction_deg")]
    return (
        row["target"],
        f"{one['predicted_rms_mm']:.2f}",
        " x ".join(f"{mm:.2f}" for mm in one["half_axes_mm"]),
        *(f"{value:.2f}" for value in numbers),
        "" if one["p_hit"] is None else chance_text(one["p_hit"]),
        f"{one['realised_mm']:.2f}",
    )
