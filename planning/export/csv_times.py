"""The plan as a table: phase, time, six angles. Times start at 0 in each phase; numbers are exact."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.export.motion import SampledMotion
from puncture_twin.planning.export.text import heading
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan

COLUMNS = ("phase", "time_s", *(f"q{joint}_rad" for joint in range(1, 7)))

NOTES = (
    "joint angles of the controller, base to wrist 3; each phase starts at time 0 and at rest",
    "the insertion is for the operator to start: nothing in this table waits",
)


def csv_text(plan: Plan, *, case_checked: bool) -> str:
    """The table, with comment lines (#) above its header."""
    lines = [*heading(plan, NOTES, case_checked=case_checked), ",".join(COLUMNS)]
    for phase in SampledMotion._fields:
        trajectory = getattr(plan, phase)
        for time, row in zip(trajectory.times_s.tolist(), trajectory.q.tolist(), strict=True):
            lines.append(",".join([phase, repr(time), *map(repr, row)]))
    return "\n".join(lines) + "\n"


def read_csv(text: str, *, where: Path) -> SampledMotion:
    """Read the table back.

    Raises:
        InputError: Another header, another phase, or rows that are no motion.
    """
    rows = list(csv.reader(io.StringIO("\n".join(line for line in text.splitlines() if not line.startswith("#")))))
    if not rows or tuple(rows[0]) != COLUMNS:
        raise InputError("the table's header is another", where=where, allowed=",".join(COLUMNS))
    phases: dict[str, list[list[float]]] = {phase: [] for phase in SampledMotion._fields}
    for number, row in enumerate(rows[1:], start=2):
        try:
            phases[row[0]].append([float(cell) for cell in row[1:]])
        except (KeyError, IndexError, ValueError) as error:
            allowed = f"{' or '.join(phases)} and seven numbers"
            raise InputError(f"row {number} of the table: {error}", where=where, allowed=allowed) from error
        if len(row) != len(COLUMNS):
            raise InputError(f"row {number} has {len(row)} cells", where=where, allowed=f"{len(COLUMNS)} cells")
    tables = [np.array(table).reshape(-1, 7) for table in phases.values()]
    return SampledMotion(*(Trajectory(table[:, 0], table[:, 1:]) for table in tables))
