"""The command that checks a list: which list it is, and what it is read and written with.

A list of entries, or of targets, checked row by row: one row out for each row in.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import InputError, NoAnswerError, refuse
from puncture_twin.planning.base.files import check_writable
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.geometry.spaces import to_lps
from puncture_twin.planning.search.choice import (
    BEST,
    Choice,
    Listed,
    ReadList,
    explain_choice,
    read_entries,
    read_targets,
)
from puncture_twin.planning.search.context import CaseContext, prepare
from puncture_twin.planning.search.explain import Explanation, finite
from puncture_twin.twin.report.present import Field, Section, footer, grid, text


def lists_of(
    entries: Path | None, targets: Path | None, choice: Choice, *, picture: Path | None, out_dir: Path | None
) -> bool:
    """Whether a list is to be checked.

    Raises:
        InputError: Two lists, a list of directions beside a choice, a picture of a list, or a folder without a list.
    """
    if entries is not None and targets is not None:
        refuse("two lists were given", "--entries, --targets", "one of them", "conflicting_options")
    if entries is not None and choice != BEST:
        refuse("a list and a choice of a direction", "--entries", "only the list", "conflicting_options")
    if (entries or targets) is not None and picture is not None:
        refuse("--picture draws one candidate", "--picture", "check without a list", "conflicting_options")
    if (entries or targets) is None and out_dir is not None:
        refuse("one candidate is only printed", "--out", "--entries or --targets", "conflicting_options")
    return (entries or targets) is not None


def check_list(
    path: Path,
    entries: Path | None,
    targets: Path | None,
    choice: Choice,
    *,
    out_dir: Path | None,
    arm: bool | None,
    watcher: Watcher,
) -> CheckedList:
    """Check a list of entries or of targets; written where a folder is named.

    Raises:
        InputError: A case, list or folder that cannot be used. A row that cannot be checked is a row that says so.
    """
    out = None if out_dir is None else check_writable(out_dir)
    context = prepare(path, arm=arm, watcher=watcher)

    def aimed(row: Listed) -> CaseContext:
        point = to_lps(np.array([row.point_mm]), context.case.space)[0]
        return context.at(point)

    if entries is not None:
        checked = check_entries(context, read_entries(entries, context.case))
    else:
        assert targets is not None
        checked = check_targets(context, read_targets(targets, context.case, choice), aimed)
    return checked if out is None else write_checked(checked, context, out)


CSV, PARQUET = "checked.csv", "checked.parquet"

REFUSED = "refused"
"""The verdict of a row that could not be checked: neither safe nor rejected."""

TYPES: Mapping[str, str] = MappingProxyType(
    {"row": "int64", "reachable": "bool", "safe_directions": "int64", "windows": "int64"}
    | dict.fromkeys(("name", "verdict", "reason", "reason_structure", "detail", "on_the_skin", "nearest"), "string")
)
"""Of the columns that are no numbers with a fraction."""
COLUMNS = (
    *("row", "name", "x_mm", "y_mm", "z_mm", "verdict", "reason", "reason_structure", "detail"),
    *("theta_deg", "beta_deg", "entry_x_mm", "entry_y_mm", "entry_z_mm", "on_the_skin"),
    *("path_length_mm", "skin_angle_deg", "min_clearance_mm", "nearest", "reachable", "p_hit", "p_touch_any"),
    *("safe_directions", "windows"),
)
"""Of the table, in this order; what has no number is empty."""


class Outcome(NamedTuple):
    """A row that was checked.

    Attributes:
        explained: None of a row that was refused, or for whose target nothing is safe.
        safe_directions: Of a target's search; None of an entry.
    """

    explained: Explanation | None
    verdict: str
    detail: str = ""
    safe_directions: int | None = None
    windows: int | None = None


@dataclass(frozen=True, eq=False)
class CheckedList:
    """All rows of a list.

    Attributes:
        arm: Whether the arm was checked: see `Candidates.arm_note`.
        inputs: The list, then what the case names.
        rows: In the order of the list, by `COLUMNS`.
        warnings: Of the list and of the case.
    """

    case_name: str
    arm: str
    inputs: tuple[Input, ...]
    rows: tuple[dict[str, Any], ...]
    warnings: tuple[str, ...]
    files: tuple[Path, ...] = ()

    @property
    def safe(self) -> bool:
        """Whether every row is."""
        return all(row["verdict"] == "safe" for row in self.rows)

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "case": self.case_name,
            "arm": self.arm,
            "inputs": inputs_document(self.inputs),
            "rows": list(self.rows),
            "warnings": list(self.warnings),
            "files": [str(path) for path in self.files],
        }

    def text(self) -> str:
        """A line a row, then what kept those that are not safe."""
        kept = [f"row {row['row']}: {_why(row)}" for row in self.rows if row["verdict"] != "safe"]
        head = Section(
            f"case {self.case_name}: {plural(len(self.rows), 'row')}, arm {self.arm}", [grid(FIELDS, self.rows), *kept]
        )
        return text([head, *footer(self.files, self.warnings)])


def check_entries(context: CaseContext, listed: ReadList) -> CheckedList:
    """Check every listed direction of one case."""

    def outcome(row: Listed) -> Outcome:
        explained = explain_choice(context, row.choice, None)
        return Outcome(explained, explained.verdict)

    return _checked(context, listed, outcome)


def check_targets(context: CaseContext, listed: ReadList, aimed: Callable[[Listed], CaseContext]) -> CheckedList:
    """Search the case again for every listed target, and explain the choice, or the best.

    Args:
        context: Of the case, for what does not depend on the target.
        aimed: The case with a row's point as its target, read anew.
    """

    def outcome(row: Listed) -> Outcome:
        there = aimed(row)
        found = there.search()
        windows = len(found.windows)
        counts = int(found.safe.sum()), windows
        try:
            explained = explain_choice(there, row.choice, found)
        except NoAnswerError as error:
            return Outcome(None, "rejected", str(error), *counts)
        return Outcome(explained, explained.verdict, "", *counts)

    return _checked(context, listed, outcome)


def write_checked(checked: CheckedList, context: CaseContext, out: Path) -> CheckedList:
    """Write a checked list's rows as CSV and Parquet into a folder."""
    names, stages, note = (CSV, PARQUET), context.stages.seconds, context.watcher.note
    with writing(out, "check list", inputs=checked.inputs, seconds=stages, names=names, note=note) as draft:
        paths = (draft.folder / CSV, draft.folder / PARQUET)
        # Here: pyarrow takes 0.05 s, and a single candidate needs none.
        import pyarrow as pa
        import pyarrow.parquet as pq

        from puncture_twin.twin.jobs.patient.export_jobs import csv_text

        rows = [[row[name] for name in COLUMNS] for row in checked.rows]
        paths[0].write_text(csv_text(COLUMNS, rows), encoding="utf-8", newline="")
        run = {**context.provenance(), "inputs": inputs_document(checked.inputs)}
        schema = pa.schema([(name, TYPES.get(name, "float64")) for name in COLUMNS])
        table = pa.Table.from_pylist(list(checked.rows), schema)
        pq.write_table(table.replace_schema_metadata({"run": json.dumps(run, sort_keys=True)}), paths[1])
    return replace(checked, files=draft.final(paths))


def _checked(context: CaseContext, listed: ReadList, outcome: Callable[[Listed], Outcome]) -> CheckedList:
    rows = []
    for done, row in enumerate(listed.rows, start=1):
        try:
            rows.append(_document(context, row, outcome(row)))
        except InputError as error:
            rows.append(_document(context, row, Outcome(None, REFUSED, str(error))))
        context.watcher.count("rows", done, len(listed.rows))
    inputs = (listed.input, *context.case.inputs)
    return CheckedList(
        context.case.name, context.arm, inputs, tuple(rows), (*listed.warnings, *context.anatomy.warnings)
    )


def _document(context: CaseContext, row: Listed, found: Outcome) -> dict[str, Any]:
    blank: dict[str, Any] = {name: "" if TYPES.get(name) == "string" else None for name in COLUMNS}
    point = {} if row.point_mm is None else dict(zip(("x_mm", "y_mm", "z_mm"), row.point_mm, strict=True))
    stated = {"row": row.number, "name": row.name, "verdict": found.verdict, "detail": found.detail}
    counts = {"safe_directions": found.safe_directions, "windows": found.windows}
    rest = {} if found.explained is None else _explained(found.explained)
    return {**blank, **point, **rest, **stated, **counts, "detail": found.detail or rest.get("detail", "")}


def _explained(explained: Explanation) -> dict[str, Any]:
    one = explained.candidates
    entry = to_lps(one.path.entry_ct, explained.case.space)[0]
    place, breakdown = explained.facts.place, explained.breakdown
    return {
        **one.at(0),
        "reason": str(one.verdict.reason[0]),
        "reason_structure": str(one.verdict.structure[0]),
        "detail": str(one.verdict.detail[0]),
        **{f"entry_{axis}_mm": finite(mm) for axis, mm in zip("xyz", entry, strict=True)},
        "on_the_skin": "" if place is None else place.text(explained.case.space),
        "path_length_mm": finite(one.path.length[0]),
        "skin_angle_deg": finite(np.degrees(one.path.skin_angle[0])),
        "min_clearance_mm": finite(one.least_clearance[0]),
        "nearest": explained.nearest_demanding(),
        "reachable": None if one.arm.reachable[0] < 0 else bool(one.arm.reachable[0]),
        "p_hit": None if breakdown is None else breakdown.p_hit,
        "p_touch_any": None if breakdown is None else breakdown.p_touch_any,
    }


FIELDS = (
    Field("row", "row"),
    Field("name", "name"),
    Field("verdict", "verdict"),
    Field("theta", "theta_deg", 1, "deg"),
    Field("beta", "beta_deg", 1, "deg"),
    Field("clearance", "min_clearance_mm", 2, "mm"),
    Field("path", "path_length_mm", 1, "mm"),
    Field("angle", "skin_angle_deg", 1, "deg"),
    Field("nearest", lambda row: "crosses " * ((row["min_clearance_mm"] or 0) < 0) + row["nearest"]),
)


def _why(row: dict[str, Any]) -> str:
    where = f" ({row['reason_structure']})" if row["reason_structure"] else ""
    reason = f"{row['reason']}{where}" if row["reason"] else row["verdict"]
    return f"{reason}: {row['detail']}" if row["detail"] else reason
