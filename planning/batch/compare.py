"""Two merged cohorts against each other: what became safe, what was lost, how far the best entries moved."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from puncture_twin.planning.base.errors import InputError, one_line
from puncture_twin.planning.base.files import is_folder
from puncture_twin.planning.base.input_file import read_input
from puncture_twin.planning.batch.merge import CASES_NAME

MAX_TABLE_BYTES = 2_000_000_000
ALLOWED = f"a cohort's folder after `batch merge`, or its {CASES_NAME}"
NEEDED = ("case", "options", "exit_code", "reason", "safe", "best_clearance_mm", "best_theta_deg", "best_beta_deg")
ENTRY = ("best_entry_x_mm", "best_entry_y_mm", "best_entry_z_mm")

CaseKey = tuple[str, str, int]
"""Case as written, options, and which of several with both alike: what stays when inputs or versions change."""


class CaseChange(NamedTuple):
    """One case in two cohorts.

    Attributes:
        case: As written.
        options: As JSON.
        before: Its row in the first; None where it is not there.
        after: The same of the second.
    """

    case: str
    options: str
    before: Mapping[str, Any] | None
    after: Mapping[str, Any] | None

    @property
    def kind(self) -> str:
        """``new``, ``gone``, ``became safe``, ``lost``, ``other reason``, or ``same``."""
        if self.before is None or self.after is None:
            return "gone" if self.after is None else "new"
        had, has = has_safe(self.before), has_safe(self.after)
        if had != has:
            return "became safe" if has else "lost"
        outcome = ("exit_code", "reason")
        return "same" if all(self.before[name] == self.after[name] for name in outcome) else "other reason"

    @property
    def moved_mm(self) -> float | None:
        """How far the best entry moved on the skin; None without two."""
        return _distance(_vector(self.before), _vector(self.after))

    @property
    def clearance_mm(self) -> float | None:
        """By how much the best candidate's clearance grew; None without two."""
        values = [None if row is None else row["best_clearance_mm"] for row in (self.before, self.after)]
        return None if values[0] is None or values[1] is None else values[1] - values[0]


@dataclass(frozen=True)
class Comparison:
    """All cases of two cohorts.

    Attributes:
        changes: In the order of the second, then what only the first has.
    """

    changes: tuple[CaseChange, ...]

    @property
    def counts(self) -> Counter[str]:
        """Kind of change to how many."""
        return Counter(one.kind for one in self.changes)

    @property
    def moved_mm(self) -> list[float]:
        """Of every case that is safe in both."""
        return [one.moved_mm for one in self.changes if one.moved_mm is not None]

    def beyond(self, tolerance_mm: float) -> list[CaseChange]:
        """The cases whose verdict changed, or whose best clearance did by more than so much."""
        return [one for one in self.changes if one.kind != "same" or not _kept(one, tolerance_mm)]


def compare(before: Sequence[Mapping[str, Any]], after: Sequence[Mapping[str, Any]]) -> Comparison:
    """Hold the rows of two merged cohorts against each other."""
    first, second = _keyed(before), _keyed(after)
    keys = [*second, *(key for key in first if key not in second)]
    return Comparison(tuple(CaseChange(key[0], key[1], first.get(key), second.get(key)) for key in keys))


def read_cases(place: Path) -> list[dict[str, Any]]:
    """The rows of a merged cohort.

    Args:
        place: Its folder, or its ``cases.parquet``.

    Raises:
        InputError: There is none, or it is something else.
    """
    path = place / CASES_NAME if is_folder(place) else place
    data = read_input(path, max_bytes=MAX_TABLE_BYTES, where=str(path))
    try:
        table = pq.read_table(io.BytesIO(data))
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"is no table ({one_line(str(error), 100)})", where=path, allowed=ALLOWED) from error
    missing = [name for name in (*NEEDED, *ENTRY) if name not in table.column_names]
    if missing:
        raise InputError(f"has no column '{missing[0]}'", where=path, allowed=ALLOWED)
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows


def has_safe(row: Mapping[str, Any]) -> bool:
    """Whether a case has a safe direction; one that was not run, or was refused, has none."""
    return row["exit_code"] == 0 and bool(row["safe"])


def _keyed(rows: Iterable[Mapping[str, Any]]) -> dict[CaseKey, Mapping[str, Any]]:
    seen: Counter[tuple[str, str]] = Counter()
    found = {}
    for row in rows:
        key = (str(row["case"]), str(row["options"]))
        found[(*key, seen[key])] = row
        seen[key] += 1
    return found


def _kept(change: CaseChange, tolerance_mm: float) -> bool:
    """Whether the best clearance is as it was; one that only one of them has is not."""
    one, other = change.before, change.after
    if one is None or other is None or (one["best_clearance_mm"] is None) != (other["best_clearance_mm"] is None):
        return False
    return change.clearance_mm is None or abs(change.clearance_mm) <= tolerance_mm


def _vector(row: Mapping[str, Any] | None) -> list[float] | None:
    values = [None if row is None else row[name] for name in ENTRY]
    return None if None in values else [float(value) for value in values if value is not None]


def _distance(one: list[float] | None, other: list[float] | None) -> float | None:
    return None if one is None or other is None else float(np.linalg.norm(np.subtract(one, other)))
