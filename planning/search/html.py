"""How the candidates of a search show themselves in a notebook."""

from __future__ import annotations

from typing import Any

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.html import Facts, card, never_raises
from puncture_twin.planning.base.polar_map import Entry, Sectors, polar_map
from puncture_twin.planning.base.reasons import REASON_COLOURS, REASON_TEXT, SAFE, Reason

SAME_ANGLE = 1e-7
"""rad: two angles nearer than this are one line of the grid."""

ALONE = np.radians(2.0)
"""rad: how wide a direction is drawn where no other has another angle."""

MOST_ROWS = 200_000
"""Directions that are painted; the table says all that there is to say about more."""


@never_raises
def candidates_html(candidates: Any) -> str:
    """A table of facts, and the map of the directions by verdict."""
    title = f"{len(candidates):,} candidates, {int(candidates.safe.sum()):,} {candidates.safe_text}"
    return card(title, _facts(candidates), _map(candidates))


def _facts(candidates: Any) -> Facts:
    yield "arm", candidates.arm_note
    ranked = candidates.ranked
    if len(ranked):
        best = int(ranked[0])
        theta, beta = np.degrees(candidates.theta[best]), np.degrees(candidates.beta[best])
        yield "best direction", f"θ {theta:g}°, β {beta:g}°"
        yield "its path, target to skin", f"{candidates.path.length[best]:.1f} mm"
        yield "its least clearance", f"{candidates.least_clearance[best]:.1f} mm"
    for code, count in candidates.counts().items():
        text = candidates.safe_text if code == "safe" else REASON_TEXT[Reason(code)]
        yield text, f"{count:,}"


def _map(candidates: Any) -> str:
    if not 0 < len(candidates) <= MOST_ROWS:
        return ""
    reasons = [Reason.NONE, *REASON_COLOURS]
    legend = [Entry(candidates.safe_text, SAFE), *(Entry(REASON_TEXT[r], REASON_COLOURS[r]) for r in reasons[1:])]
    number = {reason.value: row for row, reason in enumerate(reasons)}
    code = np.array([number[str(reason)] for reason in candidates.verdict.reason])
    azimuth, half = np.mod(candidates.beta, 2 * np.pi), np.array([-0.5, 0.5])
    steps = _step(candidates.theta), _step(azimuth)
    theta = np.clip(candidates.theta[:, None] + half * steps[0], 0.0, np.pi)
    cells = Sectors(theta, azimuth[:, None] + half * steps[1], code)
    return polar_map(cells, legend, min(steps) / 2)  # the cells' edges lie at halves of a step


def _step(values: Floats) -> float:
    """The grid's step: the least gap between two of its angles, rad."""
    gaps = np.diff(np.unique(values))
    gaps = gaps[gaps > SAME_ANGLE]
    return float(gaps.min()) if len(gaps) else ALONE
