"""Texts and numbers of pictures and page; directions and mounts in terms of the patient."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from puncture_twin.planning.base import reasons
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.place.mounts import Region, ring_weights
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.twin.report.map_view import body_directions, grid_step
from puncture_twin.twin.report.present import number

TRUTH_IS_BELIEF = (
    "in this rehearsal the patient is exactly where the belief puts them: the tip error comes from the joints "
    "alone and says nothing about the registration"
)
NEARLY = 0.985  # cosine from which a direction carries a body direction's name (10 degrees)


@dataclass(frozen=True)
class ReasonCount:
    """One line of the legend; `solid_angle` is a fraction of what was searched: the grid is denser near θ = 0."""

    text: str
    code: str
    colour: reasons.Rgb
    count: int
    solid_angle: float


def reason_counts(candidates: Candidates) -> tuple[ReasonCount, ...]:
    """Counts of the verdicts: safe first, then the reasons that occur, most frequent first."""
    weights = ring_weights(candidates.theta, grid_step(candidates))
    lines: list[tuple[str, str, reasons.Rgb, Bools]] = []
    air = candidates.unseen_air
    for value in np.unique(candidates.verdict.reason):
        rows = (candidates.verdict.reason == value) & ~air
        reason = reasons.Reason(str(value))
        text = reasons.REASON_TEXT[reason] if reason else candidates.safe_text
        lines.append((text, reason.value or "safe", reasons.REASON_COLOURS.get(reason, reasons.SAFE), rows))
    lines.append((reasons.UNSEEN_AIR_TEXT, reasons.Reason.UNKNOWN_REGION.value, reasons.UNSEEN_AIR, air))
    counts = [
        ReasonCount(text, code, colour, int(rows.sum()), float(weights[rows].sum() / weights.sum()))
        for text, code, colour, rows in lines
        if rows.any()
    ]
    if not candidates.safe.any():
        counts.append(ReasonCount(candidates.safe_text, "safe", reasons.SAFE, 0, 0.0))
    return tuple(sorted(counts, key=lambda line: (line.code != "safe", -line.count)))


def nearest_structure(candidates: Candidates, row: int) -> tuple[str, float]:
    """The structure with a margin that lies nearest to a candidate's needle, and its clearance in mm."""
    demanding = np.flatnonzero(np.isfinite(candidates.clearance.margins))
    if len(demanding) == 0:
        return "", math.nan
    best = demanding[np.argmin(candidates.clearance.by_structure[row, demanding])]
    return candidates.clearance.structures[best], float(candidates.clearance.by_structure[row, best])


def carried_digits(scan: Any | None) -> tuple[int, str]:
    """Digits of a mm that a CT's voxels carry, and half the longest side of one as " ± 0.4"; 1 and "" without."""
    if scan is None:
        return 1, ""
    half = float(np.linalg.norm(scan.grid.T_ct_index[:3, :3], axis=0).max()) / 2
    return (1, f" ± {half:.1f}") if half < 1.0 else (0, f" ± {math.ceil(half)}")


def length_text(mm: float, scan: Any | None) -> str:
    """A length in the digits that the CT carries, as "93 ± 3 mm"."""
    digits, tolerance = carried_digits(scan)
    return number(mm, digits, f"{tolerance} mm".strip())


def nearest_text(candidates: Candidates, row: int, scan: Any | None = None) -> str:
    """The nearest structure and its clearance, in digits that the CT carries, or that the needle crosses it."""
    name, clearance = nearest_structure(candidates, row)
    if not name:
        return "no structure has a margin"
    spoken = name.replace("_", " ")
    return f"crosses {spoken}" if clearance < 0 else f"nearest: {spoken}, {length_text(clearance, scan)}"


def needle_text(case: Any) -> str:
    """The needle in one line."""
    n = case.needle
    return f"needle ⌀ {n.diameter_mm:g} mm, shaft {n.shaft_mm:g} mm, tip to flange {n.length_mm:g} mm"


def clearance_text(clearance_mm: float, unit: str = "") -> str:
    """A clearance, or that the needle crosses the structure, of which a clearance below zero says too little."""
    return "crossed" if clearance_mm < 0 else number(clearance_mm, 1, unit)


def expected_text(error_mm: float) -> str:
    """An expected error (rms), or why there is none."""
    return number(error_mm, 2, "mm") if math.isfinite(error_mm) else "unknown (no markers)"


def arm_text(candidates: Candidates) -> str:
    """Whether "safe" includes the arm."""
    if not candidates.arm_checked:
        return f"arm {candidates.arm_note}; “safe” covers only the needle and the organs"
    return "“safe” includes that the arm can reach the pose and insert the needle"


def target_text(case: Any) -> str:
    """The target's name, and the structure that holds it where the two differ."""
    if case.target_name in {"target", case.target_structure}:
        return str(case.target_structure)
    return f"{case.target_name} in {case.target_structure}"


def demanding(anatomy: Any) -> frozenset[str]:
    """The structures that a needle must keep away from; it may be inside the others."""
    return frozenset(s.name for s in anatomy.structures if str(s.role) in {"avoid", "unknown"})


def direction_text(direction_ct: Floats, space: str) -> str:
    """Name of a direction (3,), unit, for a person, such as "the patient's left"; "" where none fits."""
    for name, vector in body_directions(space).items():
        if float(vector @ direction_ct) > NEARLY:
            return name if space == "local" else f"the {name}"
    return ""


def mounting_text(region: Region, T_ct_bed: Floats, space: str) -> str:
    """A region's name, with the patient's directions in it where they fit."""
    if not region.facing:
        return region.mount
    axis = region.axis if region.mount == "side" else (0, 1 if region.facing.startswith("+") else -1, 0)
    text = direction_text(np.asarray(T_ct_bed[:3, :3] @ np.asarray(axis, dtype=float)), space) or region.facing
    return f"side, base axis toward {text}" if region.mount == "side" else f"{region.mount}, on {text}"
