"""The page's words of uncertainty: how sure the chosen direction is, and what happened in many rooms."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from markupsafe import Markup

from puncture_twin.planning.search.uncertainty_breakdown import UncertaintyBreakdown, chance_text
from puncture_twin.planning.uncertainty.sources import SOURCES
from puncture_twin.twin.report.numbers import number
from puncture_twin.twin.report.page.page_tables import faint, listed, pairs, table, two
from puncture_twin.twin.report.page.template import Card, data_address

LEAST_SHOWN = 5e-5
"""A chance or share below it rounds to nothing."""

NO_CHANCES = "No chances: they need markers, the arm, and a direction that organs and arm allow."


def chance_card(breakdown: UncertaintyBreakdown) -> Card:
    """Both chances and the expected error, for the top of the page."""
    detail = (
        f"touches anything forbidden {chance_text(breakdown.p_touch_any)}; expected tip error "
        f"{number(breakdown.budget.rms_mm, 2, 'mm')} (rms); not modelled: {breakdown.not_modelled}"
    )
    return Card("chance to hit", chance_text(breakdown.p_hit), detail)


def chances_section(breakdown: UncertaintyBreakdown | None, registration: Mapping[str, Any] | None) -> Markup:
    """Chances, expected error and its sources, the declaration's test, and what would have to be better.

    Args:
        breakdown: Of the chosen direction, or None where it has no chances.
        registration: As plain values, for the FLE and its interval.
    """
    if breakdown is None:
        return Markup("<p>{}</p>").format(NO_CHANCES)
    budget, (name, chance) = breakdown.budget, breakdown.likeliest
    rows = [
        ("chance to hit the target", Markup("<b>{}</b>").format(chance_text(breakdown.p_hit))),
        ("chance to touch anything forbidden, at most", chance_text(breakdown.p_touch_any)),
        *([("most likely touched", f"{name.replace('_', ' ')}, {chance_text(chance)}")] if name else []),
        ("expected tip error (rms), this insertion", number(budget.rms_mm, 2, "mm")),
        ("across the needle (rms)", number(budget.lateral_mm, 2, "mm")),
        ("along the needle (rms)", number(budget.depth_mm, 2, "mm")),
        ("half axes of the 95 % ellipsoid", ", ".join(number(float(mm), 2) for mm in budget.half_axes_mm) + " mm"),
        *_fle(registration),
        ("the declared errors", breakdown.declaration),
        ("not modelled", breakdown.not_modelled),
    ]
    shares = [(SOURCES[source].text, f"{100 * fraction:.1f} %") for source, fraction in breakdown.sources()]
    goals = [goal.text() for goal in breakdown.goals]
    wanting = listed(goals) if goals else Markup("")
    return wanting + two(pairs(rows), table(("source", "of the error's variance"), shares, kind="numbers"))


def _fle(registration: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    if not registration or registration.get("fle_mm") is None:
        return []
    low, high = registration.get("fle_interval_mm") or (0.0, 0.0)
    interval = f" (95 %: {number(low, 2)} to {number(high, 2, 'mm')})" if low < high else ""
    return [("error of a marker, CT and touch (FLE, rms)", number(float(registration["fle_mm"]), 2, "mm") + interval)]


def rooms_section(rooms: Mapping[str, Any] | None, picture: Path | None) -> Markup:
    """Predicted beside realised, with the picture of all tips; empty without rooms.

    Args:
        rooms: A `Distribution` as plain values.
        picture: ``rooms.png``.
    """
    if rooms is None or rooms["realised_rms_mm"] is None:
        return Markup("")
    rows = [
        ("tip error, rms, mm", f"{rooms['realised_rms_mm']:.3f}", f"{rooms['predicted_rms_mm']:.3f}"),
        ("inside of the 95 % ellipsoid", _percent(rooms["coverage_95"]), _percent(0.95)),
        ("hit the target", _percent(rooms["hit_share"]), _percent(rooms["mean_p_hit"])),
        ("touched anything forbidden", _percent(rooms["touch_share"]), _percent(rooms["mean_p_touch"])),
    ]
    for name, fraction in rooms["touch_share_by_structure"].items():
        chance = rooms["p_touch_by_structure"][name]
        if max(fraction, chance) >= LEAST_SHOWN:
            rows.append((f"touched {name.replace('_', ' ')}", _percent(fraction), _percent(chance)))
    shown = table((f"{rooms['rooms']:,} rooms, seed {rooms['seed']}", "realised", "predicted"), rows, kind="numbers")
    image = Markup("")
    if picture is not None:
        form = '<p><img src="{}" style="max-width:100%" alt="Tips of all rooms in the frame of the needle"></p>'
        image = Markup(form).format(data_address(picture))
    return shown + listed(_reserves(rooms)) + image + faint(f"Not modelled: {rooms['not_modelled']}.")


def _reserves(rooms: Mapping[str, Any]) -> list[str]:
    """What a reader must know before believing the table."""
    said = []
    if rooms["wrong_belief"]:
        said.append("The rooms were drawn from [rehearsal.errors]: the belief is wrong by design.")
    if rooms["unreached"]:
        said.append(f"In {rooms['unreached']:,} rooms the arm did not reach the pose; they are not counted.")
    if rooms["guessed_touches"]:
        said.append("Nobody says how the arm touched the markers: a posture was assumed.")
    return said


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.2f} %"
