"""One table for a cohort, a row a case, and one dataset of candidates with the same columns for all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.batch.case_row import SCHEMA, blank_row
from puncture_twin.planning.batch.plan import PlannedCase
from puncture_twin.planning.batch.result import TABLE_NAME, read_row

CASES_NAME, DATASET_NAME = "cases.parquet", "candidates"

NOT_RUN = "not run"
"""The reason of a case that has no row yet; its exit code is null."""


def merged_rows(cases: Sequence[PlannedCase], out: Path) -> list[dict[str, Any]]:
    """A row for each case of the plan, in its order; one that has none yet says so.

    Args:
        cases: The plan's.
        out: The cohort's folder.
    """
    return [_row(one, out) for one in cases]


def _row(planned: PlannedCase, out: Path) -> dict[str, Any]:
    found = read_row(out, planned.id)
    if found is None:
        return blank_row(planned, None, NOT_RUN) | {"directions": None, "safe": None}
    stated = {name: getattr(planned, name) for name in ("case", "name")}
    return {name: found.get(name) for name in SCHEMA.names} | stated


def write_cases(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Write ``cases.parquet``."""
    pq.write_table(pa.Table.from_pylist(list(rows), SCHEMA), path)


def write_dataset(rows: Sequence[dict[str, Any]], out: Path, folder: Path, progress: Count) -> None:
    """Write every case's candidates as one dataset, partitioned by case: ``id=ID/candidates.parquet``.

    Every part has the union of all columns: readers take the first part's for the whole, and drop an organ that only
    later cases have, or stop.

    Args:
        rows: Of `merged_rows`.
        out: The cohort's folder.
        folder: The dataset's.
        progress: Called with (parts written, parts).

    Raises:
        InputError: Two cases give a column of one name two types.
    """
    ids = list(dict.fromkeys(row["id"] for row in rows if (out / row["id"] / TABLE_NAME).is_file()))
    schema = union_schema([pq.read_schema(out / one / TABLE_NAME) for one in ids], out)
    for number, one in enumerate(ids, start=1):
        part = folder / f"id={one}"
        part.mkdir(parents=True)
        pq.write_table(widened(pq.read_table(out / one / TABLE_NAME, partitioning=None), schema), part / TABLE_NAME)
        progress(number, len(ids))


def union_schema(schemas: Sequence[pa.Schema], where: Path) -> pa.Schema:
    """Every column of any, in the order of their first tables.

    Raises:
        InputError: A column of two types.
    """
    fields: dict[str, pa.Field] = {}
    for schema in schemas:
        for one in schema:
            known = fields.setdefault(one.name, one)
            if known.type != one.type:
                what = f"column '{one.name}' is {known.type} in one case and {one.type} in another"
                raise InputError(what, where=where, allowed="results of one version: batch plan and run again")
    return pa.schema(list(fields.values()))


def widened(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """A table with all columns of a schema, null where it has none; its own metadata stay."""
    columns = [table[one.name] if one.name in table.column_names else pa.nulls(len(table), one.type) for one in schema]
    return pa.table(columns, schema=schema.with_metadata(table.schema.metadata))
