"""The merged tables of a cohort, and two merged cohorts compared.

``cases.parquet`` has a row a case: its verdict in numbers (mm and degrees), or its reason; the dataset has the
candidates of all cases with the same columns. `compare` says what became safe and what was lost.
"""

import io
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from puncture_twin.planning.base.errors import InputError, one_line, refuse
from puncture_twin.planning.base.files import is_folder, read_input
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.base.strict_json import or_null
from puncture_twin.planning.batch.plan import TABLE_NAME, PlannedCase, read_row
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import CaseContext

CASES_NAME, DATASET_NAME = "cases.parquet", "candidates"
NOT_RUN = "not run"
"""The reason of a case that has no row yet; its exit code is null."""


def merged_rows(cases: Sequence[PlannedCase], out: Path) -> list[dict[str, Any]]:
    """A row for each case of the plan, in its order; one that has none yet says so."""
    rows = []
    for one in cases:
        row = read_row(out, one.id)
        blank = blank_row(one, None, NOT_RUN) | {"directions": None, "safe": None}
        known = row and {name: row.get(name) for name in SCHEMA.names} | {"case": one.case, "name": one.name}
        rows.append(known or blank)
    return rows


def write_cases(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Write ``cases.parquet``."""
    pq.write_table(pa.Table.from_pylist(list(rows), SCHEMA), path)


def write_dataset(rows: Sequence[dict[str, Any]], out: Path, folder: Path, progress: Count) -> None:
    """Write every case's candidates as one dataset, partitioned by case: ``id=ID/candidates.parquet``.

    Every part has the union of all columns: readers take the first part's for the whole, and drop an organ that only
    later cases have, or stop.
    """
    ids = list(dict.fromkeys(row["id"] for row in rows if (out / row["id"] / TABLE_NAME).is_file()))
    schema = union_schema([pq.read_schema(out / one / TABLE_NAME) for one in ids], out)
    for number, one in enumerate(ids, start=1):
        part = folder / f"id={one}"
        part.mkdir(parents=True)
        pq.write_table(widened(pq.read_table(out / one / TABLE_NAME, partitioning=None), schema), part / TABLE_NAME)
        progress(number, len(ids))


def union_schema(schemas: Sequence[pa.Schema], where: Path) -> pa.Schema:
    """All columns of several tables, in the order of their first table; a column of two types is refused."""
    fields: dict[str, pa.Field] = {}
    for schema in schemas:
        for one in schema:
            known = fields.setdefault(one.name, one)
            if known.type != one.type:
                what = f"column '{one.name}' is {known.type} in one case and {one.type} in another"
                refuse(what, where, "results of one version: repeat batch plan and batch run", "tables_differ")
    return pa.schema(list(fields.values()))


def widened(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """A table with all columns of a schema, null where it has none; its own metadata are unchanged."""
    columns = [table[one.name] if one.name in table.column_names else pa.nulls(len(table), one.type) for one in schema]
    return pa.table(columns, schema=schema.with_metadata(table.schema.metadata))


NO_SAFE = "no safe direction"
ENTRY = ("best_entry_x_mm", "best_entry_y_mm", "best_entry_z_mm")
SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in ("case", "id", "name")),
        ("exit_code", pa.int64()),
        ("reason", pa.string()),
        *((name, pa.int64()) for name in ("directions", "safe")),
        *((f"best_{name}_deg", pa.float64()) for name in ("theta", "beta")),
        *((f"best_{name}", pa.float64()) for name in ("clearance_mm", "path_length_mm", "skin_angle_deg")),
        *((name, pa.float64()) for name in ENTRY),
        *((f"best_p_{name}", pa.float64()) for name in ("hit", "touch_any")),
        ("windows", pa.int64()),
        *((name, pa.float64()) for name in ("safe_square_deg", "safe_entry_cm2", "reach_fraction")),
        ("arm", pa.string()),
        ("page", pa.bool_()),
        *((name, pa.string()) for name in ("options", "inputs")),
    ]
)
"""Columns of ``cases.parquet``: ``case`` as the cohort writes it; ``reason`` is null where ``exit_code`` is 0;
``reach_fraction`` of the directions that the organs leave."""


def blank_row(planned: PlannedCase, exit_code: int | None, reason: str | None) -> dict[str, Any]:
    """The row of a case that was not searched."""
    row: dict[str, Any] = dict.fromkeys(SCHEMA.names)
    stated = {name: getattr(planned, name) for name in ("case", "id", "name", "options", "inputs")}
    return row | stated | {"exit_code": exit_code, "reason": reason, "directions": 0, "safe": 0, "page": False}


def searched_row(planned: PlannedCase, context: CaseContext, candidates: Candidates) -> dict[str, Any]:
    """The row of a case that was searched."""
    safe, counts = int(candidates.safe.sum()), candidates.counts()
    most = f" (most: {next(iter(counts))})" if counts else ""  # the reason of most directions, where none is safe
    row = blank_row(planned, 0 if safe else 1, None if safe else f"{NO_SAFE}{most}")
    checked = candidates.arm.reachable >= 0  # of the organ-safe directions, where the arm was queried
    reach = float((candidates.arm.reachable[checked] == 1).mean()) if checked.any() else None
    row |= {"directions": len(candidates), "safe": safe, "arm": context.arm_note, "reach_fraction": reach}
    windows = candidates.windows
    row |= {"windows": len(windows), "safe_square_deg": sum(one.square_deg for one in windows)}
    row |= {"safe_entry_cm2": sum(one.entry_cm2 for one in windows)}
    return row | _best(candidates) if safe else row


def _best(candidates: Candidates) -> dict[str, Any]:
    row = int(candidates.ranked[0])
    chances = candidates.chances
    return {
        "best_theta_deg": float(np.degrees(candidates.theta[row])),
        "best_beta_deg": float(np.degrees(candidates.beta[row])),
        "best_clearance_mm": or_null(candidates.least_clearance[row]),
        "best_path_length_mm": or_null(candidates.path.length[row]),
        "best_skin_angle_deg": or_null(float(np.degrees(candidates.path.skin_angle[row]))),
        **{f"best_entry_{axis}_mm": or_null(candidates.path.entry_ct[row, k]) for k, axis in enumerate("xyz")},
        "best_p_hit": None if chances is None else or_null(chances.hit[row]),
        "best_p_touch_any": None if chances is None else or_null(chances.touch_any[row]),
    }


MAX_TABLE_BYTES = 2_000_000_000
ALLOWED = f"a cohort's folder after `batch merge`, or its {CASES_NAME}"
NEEDED = ("case", "options", "exit_code", "reason", "safe", "best_clearance_mm", "best_theta_deg", "best_beta_deg")
CaseKey = tuple[str, str, int]
"""Case as written, options, and which of several with both alike: what stays when inputs or versions change."""


class CaseChange(NamedTuple):
    """One case in two cohorts: its row in the first and in the second; None where it is not there."""

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
        """Distance between the best entries on the skin, mm; None without two."""
        entries = [row and [row[name] for name in ENTRY] for row in (self.before, self.after)]
        if any(entry is None or None in entry for entry in entries):
            return None
        return float(np.linalg.norm(np.diff(np.array(entries, np.float64), axis=0)))

    @property
    def clearance_mm(self) -> float | None:
        """Growth of the best candidate's clearance, mm; None without two."""
        values = [None if row is None else row["best_clearance_mm"] for row in (self.before, self.after)]
        return None if values[0] is None or values[1] is None else values[1] - values[0]


@dataclass(frozen=True)
class Comparison:
    """Two cohorts compared, case by case, in the order of the second, then what only the first has."""

    changes: tuple[CaseChange, ...]

    @property
    def counts(self) -> Counter[str]:
        """Number of cases by kind of change."""
        return Counter(one.kind for one in self.changes)

    @property
    def moved_mm(self) -> list[float]:
        """Distances between the best entries of every case that is safe in both, mm."""
        return [one.moved_mm for one in self.changes if one.moved_mm is not None]

    def beyond(self, tolerance_mm: float) -> list[CaseChange]:
        """The cases whose verdict changed, or whose best clearance did by more than so much."""
        changed = []
        for one in self.changes:
            clearances = [row["best_clearance_mm"] for row in (one.before, one.after) if row is not None]
            alike = one.clearance_mm is None or abs(one.clearance_mm) <= tolerance_mm
            if one.kind != "same" or clearances.count(None) == 1 or not alike:
                changed.append(one)
        return changed


def compare(before: Sequence[Mapping[str, Any]], after: Sequence[Mapping[str, Any]]) -> Comparison:
    """Compare the rows of two merged cohorts."""
    first, second = _keyed(before), _keyed(after)
    keys = [*second, *(key for key in first if key not in second)]
    return Comparison(tuple(CaseChange(key[0], key[1], first.get(key), second.get(key)) for key in keys))


def read_cases(place: Path) -> list[dict[str, Any]]:
    """The rows of a merged cohort, by its folder or its ``cases.parquet``; anything else is refused."""
    path = place / CASES_NAME if is_folder(place) else place
    data = read_input(path, max_bytes=MAX_TABLE_BYTES, where=str(path))
    try:
        table = pq.read_table(io.BytesIO(data))
    except (pa.ArrowException, OSError) as error:
        what = f"is not a table ({one_line(str(error), 100)})"
        raise InputError(what, where=path, allowed=ALLOWED, code="not_parquet") from error
    missing = [name for name in (*NEEDED, *ENTRY) if name not in table.column_names]
    if missing:
        refuse(f"has no column '{missing[0]}'", path, ALLOWED, "missing_column")
    rows: list[dict[str, Any]] = table.to_pylist()
    return rows


def has_safe(row: Mapping[str, Any]) -> bool:
    """Whether a case has a safe direction; one that was not run, or was refused, has none."""
    return row["exit_code"] == 0 and bool(row["safe"])


def _keyed(rows: Iterable[Mapping[str, Any]]) -> dict[CaseKey, Mapping[str, Any]]:
    seen: Counter[tuple[str, str]] = Counter()
    by_key = {}
    for row in rows:
        key = (str(row["case"]), str(row["options"]))
        by_key[(*key, seen[key])] = row
        seen[key] += 1
    return by_key
