"""The table of candidates for programs that read no Parquet: CSV or JSON, read back and equal before it is shown."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.output.manifest import read_output
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.provenance import Input, inputs_document, read_inputs
from puncture_twin.planning.base.strict_json import parse_json
from puncture_twin.planning.base.text import Shown
from puncture_twin.planning.search.candidates import ANGLE_DIGITS
from puncture_twin.planning.search.choice import BEST, Choice
from puncture_twin.twin.jobs.patient.main_job import is_plan

TABLE = "candidates.parquet"
ALLOWED = "a case, or the candidates.parquet of a search, or its folder"
MAX_TABLE_BYTES = 4_000_000_000
"""Twice a million directions with 60 structures."""

ROUNDED = ("theta_deg", "beta_deg")
"""Tables of older versions have 59.99999999999999 for 60."""


@dataclass(frozen=True, repr=False)
class ExportedTable(Shown):
    """What was written."""

    format_name: str
    path: Path
    rows: int
    inputs: tuple[Input, ...]

    def summary(self) -> dict[str, Any]:
        """As plain values."""
        inputs = inputs_document(self.inputs)
        return {"format": self.format_name, "rows": self.rows, "inputs": inputs, "files": [str(self.path)]}

    def text(self) -> str:
        """As a line."""
        return f"{self.format_name}: {self.rows} rows in {self.path}"


def table_of(source: Path, choice: Choice) -> Path | None:
    """The table that a source is or holds; None of a case, whose folder has a ``case.toml``.

    Raises:
        InputError: One candidate is chosen, or a plan is the source.
    """
    if choice != BEST or is_plan(source):
        refuse("a table holds all candidates", source, f"{ALLOWED}; no choice", "conflicting_options")
    if source.suffix.lower() == ".parquet":
        return source
    table = source / TABLE
    return table if table.is_file() and not (source / "case.toml").is_file() else None


def export_candidates(table_path: Path, format_name: str, out: Path, note: Callable[[str], None]) -> ExportedTable:
    """Write a table of candidates as text, beside its own set or elsewhere.

    Args:
        note: Told in a sentence what whoever reads it should know.

    Raises:
        InputError: No table of candidates, or not the one that its folder's manifest lists.
    """
    found = read_output(table_path, max_bytes=MAX_TABLE_BYTES)
    if found.note:
        note(f"warning: {found.note}")
    table, source = _table(found.data, table_path), found.input("candidates")
    run = json.loads(table.schema.metadata[b"run"])
    inputs = (source, *read_inputs(run["inputs"]))
    name = f"candidates.{format_name.removeprefix('candidates-')}"
    columns, rows = table.column_names, _rows(table)
    write, read = _WRITERS[format_name], _READERS[format_name]
    text = write(run, columns, rows)
    if read(text, table) != rows:
        raise ArithmeticError(f"{name} does not read back as the table")
    made_from = {source.path: source.sha256}
    with writing(out, f"export {name}", inputs=inputs, names=(name,), made_from=made_from, note=note) as draft:
        path = draft.folder / name
        path.write_text(text, encoding="utf-8", newline="")
    return ExportedTable(format_name, draft.final((path,))[0], len(rows), inputs)


def _table(data: bytes, path: Path) -> pa.Table:
    try:
        table = pq.read_table(pa.BufferReader(data))
    except (pa.ArrowException, OSError) as error:
        what = f"no Parquet file ({str(error)[:100]})"
        raise InputError(what, where=path, allowed=ALLOWED, code="not_parquet") from error
    if b"run" not in (table.schema.metadata or {}) or not {*ROUNDED, "verdict"} <= set(table.column_names):
        refuse("no table of candidates", path, ALLOWED, "no_such_file")
    return table


def _rows(table: pa.Table) -> list[list[Any]]:
    columns = [column.to_pylist() for column in table.columns]
    for at, name in enumerate(table.column_names):
        if name in ROUNDED:
            columns[at] = [round(value, ANGLE_DIGITS) for value in columns[at]]
    return [list(row) for row in zip(*columns, strict=True)]


def _csv(run: Mapping[str, Any], columns: list[str], rows: list[list[Any]]) -> str:
    del run  # a CSV has no place for it; the manifest lists the inputs
    return csv_text(columns, rows)


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table as CSV; what has no value is empty."""
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_field(value) for value in row] for row in rows)
    return stream.getvalue()


def _field(value: Any) -> str:
    if value is None:
        return ""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _read_csv(text: str, table: pa.Table) -> list[list[Any]]:
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    next(reader)
    kinds = [_value_of(kind) for kind in table.schema.types]
    return [[kind(field) for kind, field in zip(kinds, fields, strict=True)] for fields in reader]


def _value_of(kind: pa.DataType) -> Callable[[str], Any]:
    if pa.types.is_string(kind):
        return str
    if pa.types.is_boolean(kind):
        return lambda field: {"true": True, "false": False}.get(field)
    number: Callable[[str], Any] = int if pa.types.is_integer(kind) else float
    return lambda field: None if field == "" else number(field)


def _json(run: Mapping[str, Any], columns: list[str], rows: list[list[Any]]) -> str:
    return json.dumps({"run": run, "columns": columns, "rows": rows}, allow_nan=False) + "\n"


def _read_json(text: str, table: pa.Table) -> list[list[Any]]:
    document = parse_json(text.encode(), where="candidates.json", allowed="what was written")
    return list(document["rows"]) if document["columns"] == table.column_names else []


_WRITERS: Mapping[str, Callable[[Mapping[str, Any], list[str], list[list[Any]]], str]] = MappingProxyType(
    {"candidates-csv": _csv, "candidates-json": _json}
)
_READERS: Mapping[str, Callable[[str, pa.Table], list[list[Any]]]] = MappingProxyType(
    {"candidates-csv": _read_csv, "candidates-json": _read_json}
)
CANDIDATE_FORMATS = tuple(_WRITERS)
"""Of ``export --format``."""
