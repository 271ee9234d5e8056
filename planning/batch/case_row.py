"""One row a case: its verdict in numbers, or its reason. mm and degrees."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa

from puncture_twin.planning.base.strict_json import or_null
from puncture_twin.planning.batch.plan import PlannedCase
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.selection.windows import find_windows

NO_SAFE = "no safe direction"

SCHEMA = pa.schema(
    [
        ("case", pa.string()),
        ("id", pa.string()),
        ("name", pa.string()),
        ("exit_code", pa.int64()),
        ("reason", pa.string()),
        ("directions", pa.int64()),
        ("safe", pa.int64()),
        ("best_theta_deg", pa.float64()),
        ("best_beta_deg", pa.float64()),
        ("best_clearance_mm", pa.float64()),
        ("best_path_length_mm", pa.float64()),
        ("best_skin_angle_deg", pa.float64()),
        ("best_entry_x_mm", pa.float64()),
        ("best_entry_y_mm", pa.float64()),
        ("best_entry_z_mm", pa.float64()),
        ("best_p_hit", pa.float64()),
        ("best_p_touch_any", pa.float64()),
        ("windows", pa.int64()),
        ("safe_square_deg", pa.float64()),
        ("safe_entry_cm2", pa.float64()),
        ("reach_fraction", pa.float64()),
        ("arm", pa.string()),
        ("page", pa.bool_()),
        ("options", pa.string()),
        ("inputs", pa.string()),
    ]
)
"""Columns of ``cases.parquet``: ``case`` as the cohort writes it; ``reason`` is null where ``exit_code`` is 0;
``reach_fraction`` of the directions that the organs leave."""


def blank_row(planned: PlannedCase, exit_code: int | None, reason: str | None) -> dict[str, Any]:
    """The row of a case that was not searched."""
    row: dict[str, Any] = dict.fromkeys(SCHEMA.names)
    stated = {name: getattr(planned, name) for name in ("case", "id", "name", "options", "inputs")}
    return row | stated | {"exit_code": exit_code, "reason": reason, "directions": 0, "safe": 0, "page": False}


def found_row(planned: PlannedCase, context: CaseContext, found: Candidates) -> dict[str, Any]:
    """The row of a case that was searched."""
    safe = int(found.safe.sum())
    row = blank_row(planned, 0 if safe else 1, None if safe else no_safe_reason(found))
    row |= {"directions": len(found), "safe": safe, "arm": context.arm, "reach_fraction": _reach(found)}
    windows = find_windows(found).windows
    row |= {"windows": len(windows), "safe_square_deg": sum(one.square_deg for one in windows)}
    row |= {"safe_entry_cm2": sum(one.entry_cm2 for one in windows)}
    return row | _best(found) if safe else row


def no_safe_reason(found: Candidates) -> str:
    """With what most directions fell to."""
    counts = found.counts()
    return f"{NO_SAFE} (most: {next(iter(counts))})" if counts else NO_SAFE


def _best(found: Candidates) -> dict[str, Any]:
    row = int(found.ranked[0])
    chances = found.chances
    return {
        "best_theta_deg": float(np.degrees(found.theta[row])),
        "best_beta_deg": float(np.degrees(found.beta[row])),
        "best_clearance_mm": or_null(found.least_clearance[row]),
        "best_path_length_mm": or_null(found.path.length[row]),
        "best_skin_angle_deg": or_null(float(np.degrees(found.path.skin_angle[row]))),
        **{f"best_entry_{axis}_mm": or_null(found.path.entry_ct[row, k]) for k, axis in enumerate("xyz")},
        "best_p_hit": None if chances is None else or_null(chances.hit[row]),
        "best_p_touch_any": None if chances is None else or_null(chances.touch_any[row]),
    }


def _reach(found: Candidates) -> float | None:
    """Which fraction of the directions that the organs leave the arm reaches; None where nobody asked it."""
    checked = found.arm.reachable >= 0
    return float((found.arm.reachable[checked] == 1).mean()) if checked.any() else None
