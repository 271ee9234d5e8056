"""A list of entries, or of targets, checked row by row: one row out for each row in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import InputError, NoAnswerError, refuse
from puncture_twin.planning.base.files import check_writable
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.geometry.spaces import to_lps
from puncture_twin.planning.search.choice import BEST, Choice, Listed, explain_choice, read_entries, read_targets
from puncture_twin.planning.search.context import CaseContext, prepare
from puncture_twin.planning.search.explain import Explanation, finite
from puncture_twin.twin.report.present import Field, Section, footer, grid, text


def checks_list(
    entries: Path | None, targets: Path | None, choice: Choice, *, picture: Path | None, out_dir: Path | None
) -> bool:
    """Whether a list is to be checked; options that do not go together are refused."""
    listed = entries is not None or targets is not None
    if entries is not None and targets is not None:
        refuse("two lists were given", "--entries, --targets", "one of them", "conflicting_options")
    if entries is not None and choice != BEST:
        refuse("a list and a choice of a direction", "--entries", "only the list", "conflicting_options")
    if listed and picture is not None:
        refuse("--picture draws one candidate", "--picture", "check without a list", "conflicting_options")
    if not listed and out_dir is not None:
        refuse("one candidate is only printed", "--out", "--entries or --targets", "conflicting_options")
    return listed


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
    """Check a list of entries or of targets; written where a folder is named."""
    out = None if out_dir is None else check_writable(out_dir)
    context = prepare(path, arm=arm, watcher=watcher)
    if entries is not None:
        listed = read_entries(entries, context.case)
    else:
        assert targets is not None
        listed = read_targets(targets, context.case, choice)
    rows = []
    for done, row in enumerate(listed.rows, start=1):
        try:
            rows.append(_document(row, _outcome(context, row, of_target=entries is None)))
        except InputError as error:
            rows.append(_document(row, Outcome(None, REFUSED, str(error))))
        context.watcher.count("rows", done, len(listed.rows))
    inputs, warnings = (listed.input, *context.case.inputs), (*listed.warnings, *context.anatomy.warnings)
    checked = CheckedList(context.case.name, context.arm_note, inputs, tuple(rows), warnings)
    return checked if out is None else _written(checked, context, out)


CSV, PARQUET = "checked.csv", "checked.parquet"
REFUSED = "refused"  # the verdict of a row that could not be checked: neither safe nor rejected

TYPES: Mapping[str, str] = {  # of the columns that are no numbers with a fraction
    "row": "int64",
    "reachable": "bool",
    "safe_directions": "int64",
    "windows": "int64",
    **dict.fromkeys(("name", "verdict", "reason", "reason_structure", "detail", "on_the_skin", "nearest"), "string"),
}
COLUMNS = (  # of the table, in this order; what has no number is empty
    *("row", "name", "x_mm", "y_mm", "z_mm", "verdict", "reason", "reason_structure", "detail"),
    *("theta_deg", "beta_deg", "entry_x_mm", "entry_y_mm", "entry_z_mm", "on_the_skin"),
    *("path_length_mm", "skin_angle_deg", "min_clearance_mm", "nearest", "reachable", "p_hit", "p_touch_any"),
    *("safe_directions", "windows"),
)


class Outcome(NamedTuple):
    """A row that was checked, explained unless it was refused or nothing is safe; counts are of a target's search."""

    explained: Explanation | None
    verdict: str
    detail: str = ""
    safe_directions: int | None = None
    windows: int | None = None


@dataclass(frozen=True, eq=False)
class CheckedList:
    """All rows of a list in its order, by `COLUMNS`; inputs and warnings of the list, then of the case."""

    case_name: str
    arm: str
    inputs: tuple[Input, ...]
    rows: tuple[dict[str, Any], ...]
    warnings: tuple[str, ...]
    files: tuple[Path, ...] = ()

    @property
    def safe(self) -> bool:
        """Whether every row is safe."""
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
        """A line a row, then why those that are not safe are rejected."""
        unfit = []
        for row in self.rows:
            where = f" ({row['reason_structure']})" if row["reason_structure"] else ""
            why = f"{row['reason']}{where}" if row["reason"] else row["verdict"]
            detail = f": {row['detail']}" if row["detail"] else ""
            unfit += [f"row {row['row']}: {why}{detail}"] if row["verdict"] != "safe" else []
        head = Section(
            f"case {self.case_name}: {plural(len(self.rows), 'row')}, arm {self.arm}", [grid(FIELDS, self.rows), *unfit]
        )
        return text([head, *footer(self.files, self.warnings)])


def _outcome(context: CaseContext, row: Listed, *, of_target: bool) -> Outcome:
    """An entry explained; or the case searched again about a listed target, and the choice there, or the best."""
    if not of_target:
        explained = explain_choice(context, row.choice, None)
        return Outcome(explained, explained.verdict)
    there = context.at(to_lps(np.array([row.point_mm]), context.case.space)[0])
    candidates = there.search()
    counts = int(candidates.safe.sum()), len(candidates.windows)
    try:
        explained = explain_choice(there, row.choice, candidates)
    except NoAnswerError as error:
        return Outcome(None, "rejected", str(error), *counts)
    return Outcome(explained, explained.verdict, "", *counts)


def _document(row: Listed, outcome: Outcome) -> dict[str, Any]:
    document: dict[str, Any] = {name: "" if TYPES.get(name) == "string" else None for name in COLUMNS}
    document |= {} if row.point_mm is None else dict(zip(("x_mm", "y_mm", "z_mm"), row.point_mm, strict=True))
    if (explained := outcome.explained) is not None:
        one, place, breakdown = explained.candidates, explained.facts.place, explained.breakdown
        entry = to_lps(one.path.entry_ct, explained.case.space)[0]
        document |= {
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
    document |= {"row": row.number, "name": row.name, "verdict": outcome.verdict, "windows": outcome.windows}
    return document | {"safe_directions": outcome.safe_directions, "detail": outcome.detail or document["detail"]}


def _written(checked: CheckedList, context: CaseContext, out: Path) -> CheckedList:
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
