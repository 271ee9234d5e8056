"""The plan of a cohort (``plan.parquet``) and the results of its cases on disk.

A case's id is the hash of its inputs, its options and the program. Its result is a folder ``DIR/ID`` that appears by
one rename, with everything in it or not at all.
"""

import errno
import hashlib
import io
import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from puncture_twin.planning.base.cache.source_stamp import source_stamp
from puncture_twin.planning.base.errors import InputError, PlanningError, one_line, refuse
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.output import manifest
from puncture_twin.planning.base.output.manifest import Manifest, ManifestEntry, file_digest, problems, read_output
from puncture_twin.planning.base.provenance import CASE_ROLE, Input, content_input, inputs_document
from puncture_twin.planning.base.strict_json import read_json
from puncture_twin.planning.base.toml_file import find_toml, read_toml_bytes
from puncture_twin.planning.batch.cohort import CohortCase
from puncture_twin.planning.case.case import ALLOWED_CASE, load_case
from puncture_twin.planning.case.case_file import case_options

PLAN_NAME, MAX_PLAN_BYTES, ID_DIGITS = "plan.parquet", 2_000_000_000, 32
"""Hexadecimal digits of an id: 128 bits, and too many digits for a number in any reader of partitions."""
DECIDES, STAMP_DIGITS = "puncture_twin.planning.batch.run_case", 12
"""The module that makes a case's row, with all that it imports; and digits of the hash of their code."""
OWN_FOLDER = "the case's folder"
NO_PLAN = "a folder written by `batch plan COHORT --out DIR`"


@dataclass(frozen=True)
class PlannedCase:
    """A row of the plan."""

    case: str
    id: str  # hash of inputs, options and program; also the name of its result's folder
    name: str
    path: str
    options: str
    arm: bool | None  # False leaves the arm out; None checks it where the case says where its base is
    inputs: str  # role, path and SHA-256 of each file, as JSON
    refusal: str  # why the case cannot be read, or ""


SCHEMA = pa.schema([(one.name, pa.bool_() if one.name == "arm" else pa.string()) for one in fields(PlannedCase)])


@dataclass(frozen=True)
class Plan:
    """A cohort's plan, and the `program` that made it."""

    cases: tuple[PlannedCase, ...]
    sha256: str
    version: str


@cache
def program() -> str:
    """The version, and a hash of the code that gives a verdict: between two releases one version has many programs."""
    return f"{version('puncture-twin')}+{source_stamp(DECIDES)[:STAMP_DIGITS]}"


def case_id(options: str, arm: bool | None, inputs: Sequence[Input], refusal: str) -> str:
    """The id of a case: the same bytes, options and program give the same id, wherever the files lie."""
    stated = [(one.role, "" if one.role == CASE_ROLE else one.path, one.sha256) for one in inputs]
    decides = {"version": program(), "options": options, "arm": arm, "refusal": refusal}
    text = json.dumps({**decides, "inputs": sorted(stated)}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:ID_DIGITS]


def planned(cohort: Sequence[CohortCase], arm: bool | None) -> Iterator[PlannedCase]:
    """A row for each case, also for one that cannot be read: each file is read and hashed, nothing is searched."""
    for one in cohort:
        row = PlannedCase(one.stated, "", one.name, "", one.options.text, arm, "[]", "")
        yield identified(replace(row, path=str(one.path.absolute())))


def identified(row: PlannedCase) -> PlannedCase:
    """The row with the id, the inputs and the refusal that its files give now."""
    try:
        case = load_case(row.path, case_options(json.loads(row.options), where=row.case))
        inputs, refusal, name = case.inputs, "", case.name
        called = f"{name}: {row.name}" if row.name and row.options != "{}" else row.name or name
    except PlanningError as error:
        refusal, called, inputs = relative_text(str(error), row), row.name, ()
        with suppress(InputError):  # the case file, where it can be read
            path = find_toml(row.path, "case.toml")
            inputs = (content_input(CASE_ROLE, path.name, read_toml_bytes(path, ALLOWED_CASE)),)
    stated = json.dumps(inputs_document(inputs))
    updated = replace(row, id=case_id(row.options, row.arm, inputs, refusal), inputs=stated, refusal=refusal)
    return updated if row.id else replace(updated, name=called)


def relative_text(text: str, row: PlannedCase) -> str:
    """A case's message without the folder in which it happens to lie: the same bytes give the same text."""
    path = Path(row.path)
    folder = str(path.parent if path.suffix == ".toml" else path)
    return one_line(text.replace(f"{folder}/", "").replace(folder, OWN_FOLDER))


def write_plan_table(rows: Sequence[PlannedCase], path: Path) -> None:
    """Write the plan, whole or not at all."""
    schema = SCHEMA.with_metadata({"version": program()})
    table = pa.Table.from_pylist([asdict(row) for row in rows], schema)
    with atomic(path) as temporary, temporary.open("wb") as stream:
        pq.write_table(table, stream)


def read_plan_table(out: Path) -> Plan:
    """The plan of a folder; none, or one that is not as it was written, is refused."""
    path = out / PLAN_NAME
    if not path.is_file():
        refuse("has no plan", out, NO_PLAN, "no_batch_plan")
    output = read_output(path, max_bytes=MAX_PLAN_BYTES)
    try:
        table = pq.read_table(io.BytesIO(output.data))
        rows: list[dict[str, Any]] = table.to_pylist()
        made_by = (table.schema.metadata or {})[b"version"].decode()
        return Plan(tuple(PlannedCase(**row) for row in rows), output.sha256, made_by)
    except (pa.ArrowException, TypeError, KeyError, OSError) as error:
        what = f"is not a plan ({one_line(str(error), 100)})"
        raise InputError(what, where=path, allowed=NO_PLAN, code="not_parquet") from error


ROW_NAME, TABLE_NAME, PAGE_NAME = "row.json", "candidates.parquet", "report.html"
ENTRY = "batch"
"""Name of the entry of a result's manifest."""
MAX_ROW_BYTES = 1_000_000
PROGRAM_FAILED = 3
"""The exit code of a case at which the program, not the case, failed: the next run tries it again."""
IS_THERE = frozenset({errno.ENOTEMPTY, errno.EEXIST})
"""Error numbers of a rename where another result is there already."""
WORK_PREFIX = ".puncture-twin-cases-"
"""Folders of results that are being written; who holds the lock of a part knows that nobody else writes to its own."""


def new_draft(work: Path, case_id: str) -> Path:
    """A new folder for the files of a result."""
    return Path(tempfile.mkdtemp(prefix=f"{case_id[:8]}-{os.getpid()}-", dir=work))


def commit(draft: Path, out: Path, case_id: str, inputs: Sequence[Input], timings: Mapping[str, Any]) -> bool:
    """Put a draft in its place, with its manifest, by one rename; the second of two is discarded.

    ``timings`` differ from run to run: seconds, attempts. Returns whether it is this draft that is there now.
    """
    files = {path.name: file_digest(path) for path in sorted(draft.iterdir())}
    listed = Manifest({ENTRY: ManifestEntry(version("puncture-twin"), tuple(inputs), (), files)})
    (draft / manifest.MANIFEST_NAME).write_text(listed.text(), encoding="utf-8")
    stated = {"started": datetime.now(UTC).isoformat(timespec="seconds"), **timings}
    times = json.dumps({ENTRY: stated}, indent=1, allow_nan=False)
    (draft / manifest.TIMINGS_NAME).write_text(times + "\n", encoding="utf-8")
    try:
        draft.chmod(0o755)
        draft.rename(out / case_id)
    except OSError as error:
        if error.errno not in IS_THERE:
            raise
        shutil.rmtree(draft, ignore_errors=True)
        return False
    return True


def read_row(out: Path, case_id: str) -> dict[str, Any] | None:
    """The row of a result; None where there is none, or one whose files are not those that were written."""
    folder = out / case_id
    try:
        if not folder.is_dir() or problems(folder):
            return None
        row = read_json(folder / ROW_NAME, max_bytes=MAX_ROW_BYTES, allowed="the row of a case")
    except (InputError, OSError):
        return None
    return row if isinstance(row, dict) and row.get("id") == case_id and isinstance(row.get("exit_code"), int) else None


def write_row(row: Mapping[str, Any], draft: Path) -> None:
    """Write a result's row into its draft."""
    text = json.dumps(row, indent=1, sort_keys=True, allow_nan=False)
    (draft / ROW_NAME).write_text(text + "\n", encoding="utf-8")


def is_final(row: Mapping[str, Any] | None) -> bool:
    """Whether a case has a final result and need not run again."""
    return row is not None and row["exit_code"] != PROGRAM_FAILED


def discard(out: Path, case_id: str, work: Path) -> None:
    """Remove a result that is not final or not whole, at once or not at all."""
    folder = out / case_id
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        refuse(f"{case_id} in it is not a result of this cohort", out, "a folder of its own", "folder_of_another")
    if folder.is_dir():
        gone = new_draft(work, case_id)
        folder.rename(gone / "old")
        shutil.rmtree(gone, ignore_errors=True)
