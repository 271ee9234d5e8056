"""The page's error budget: what each source of the tip's error costs, and what would win the next millimetre."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from puncture_twin.twin.report.page.page_tables import faint, table, two
from puncture_twin.twin.report.page.template import png_address

SHOWN_MM = 0.005
"""A source that costs less would be 0.00."""


def budget_section(facts: Mapping[str, Any]) -> Markup:
    """The picture, and its numbers.

    Args:
        facts: As ``register --json`` has them under ``budget``, of the direction that is shown.
    """
    from puncture_twin.twin.report.budget_picture import budget_png  # with matplotlib, only where there is a budget

    now, best = facts["expected_mm"], facts["best"]
    won = now - best["expected_mm"]
    head = f"Expected tip error of this insertion: {now:.2f} mm (rms)"
    text = f"{head}. The next {won:.2f} mm is won by {best['text']}." if won >= SHOWN_MM else f"{head}."
    form = (
        "<p>{}</p>"
        '<p><img src="{}" style="max-width:100%" alt="What each source of the error costs, and what changes leave"></p>'
    )
    sources = [
        (one["text"], f"{one['alone_mm']:.2f}", f"{one['without_mm']:.2f}")
        for one in facts["sources"]
        if one["alone_mm"] >= SHOWN_MM
    ]
    changes = [(one["text"], f"{one['expected_mm']:.2f}") for one in facts["changes"]]
    numbers = two(
        table(("source", "alone, mm", "all but it, mm"), sources, kind="numbers"),
        table(("with this one change", "expected, mm"), changes, kind="numbers"),
    )
    shown = Markup(form).format(text, png_address(budget_png(facts)))
    return shown + numbers + faint(f"Not modelled: {facts['not_modelled']}.")
