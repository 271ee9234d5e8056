"""The abdomen that breathes: how many directions stay safe for the organs, and what the phases cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from time import process_time

import numpy as np

from benchmarks.experiment.row import Row
from puncture_twin.meshes import folder
from puncture_twin.planning.breathing.breathing import Breathing, fraction_within
from puncture_twin.planning.formats.labels.naming import ByName
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.search import organ_candidates

WEIGHTS = {
    "*": 0.0, "skin": 0.3, "liver": 1.0, "gallbladder": 1.0, "portal_vein": 0.9, "hepatic_veins": 1.0, "kidney_*": 0.7,
    "spleen": 0.9, "pancreas": 0.6, "stomach": 0.8, "duodenum": 0.5, "colon": 0.5, "small_bowel": 0.4, "heart": 0.3,
    "lung_*": 0.8, "vena_cava_inferior": 0.3,
}  # fmt: skip
"""Invented."""


def breath(gate: float | None = None, amplitude_mm: float = 12.0, phases: int = 8) -> Breathing:
    """To the feet, cos^4, scanned at exhale."""
    return Breathing(amplitude_mm, np.array([0.0, 0.0, -1.0]), ByName(WEIGHTS), phases, 2, 0.0, gate)


def rows() -> list[Row]:
    """All figures of the part."""
    context = prepare(folder() / "abdomen", arm=False)
    directions = context.case.directions()

    def searched(declared: Breathing | None) -> Candidates:
        case = replace(context.case, breathing=declared)
        return organ_candidates(case, context.anatomy, context.engine, directions)

    static, gated, every = (_timed(searched, one) for one in (None, breath(0.25), breath()))
    still, once = searched(breath(amplitude_mm=0.0)), searched(breath(phases=1))
    count = len(breath().positions)
    return [
        Row(f"safe for the organs of {len(directions)}: where the CT shows the body", f"{_safe(static[0])}", "", True),
        Row("... when gated to s <= 0.25", f"{_safe(gated[0])}", "", True),
        Row("... at each phase if inserted at that phase", f"{_safe(every[0])}", "", True),
        Row.at_most("safe at every phase and not when gated", int((every[0].safe & ~gated[0].safe).sum()), 0),
        Row.at_most("amplitude 0: other verdicts than static", _differ(still, static[0]), 0),
        Row.at_most("one phase: other verdicts than static", _differ(once, static[0]), 0),
        Row("static search, CPU s", f"{static[1]:.2f}", "", True),
        Row.at_most(f"{count} positions, over static (CPU)", every[1] / static[1], count),
        Row("cos^4, 12 mm: fraction of time within 2 mm of exhale", f"{fraction_within(2 / 12, 2):.2f}", "", True),
    ]


def _safe(found: Candidates) -> int:
    return int(found.safe.sum())


def _differ(found: Candidates, other: Candidates) -> int:
    """Rows whose reason or clearance is not the same, to the last bit."""
    clearance = (found.clearance.distance != other.clearance.distance).any(axis=1)
    return int(((found.verdict.reason != other.verdict.reason) | clearance).sum())


def _timed(searched: Callable[[Breathing | None], Candidates], declared: Breathing | None) -> tuple[Candidates, float]:
    """The second of two searches and its CPU seconds: the first compiles, and sees the surfaces from new points."""
    searched(declared)
    start = process_time()
    return searched(declared), process_time() - start
