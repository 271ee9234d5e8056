"""The result of one case: a folder ``DIR/ID`` that appears by one rename, with everything in it or not at all."""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.output.manifest import (
    MANIFEST_NAME,
    TIMINGS_NAME,
    Manifest,
    ManifestEntry,
    file_digest,
    problems,
)
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.base.strict_json import read_json

ROW_NAME, TABLE_NAME, PAGE_NAME = "row.json", "candidates.parquet", "report.html"
ENTRY = "batch"
"""Of a result's manifest."""

MAX_ROW_BYTES = 1_000_000

PROGRAM_FAILED = 3
"""The exit code of a case at which the program, not the case, failed: the next run tries it again."""

IS_THERE = frozenset({errno.ENOTEMPTY, errno.EEXIST})
"""What the system says where another result is there already."""

WORK_PREFIX = ".puncture-twin-cases-"
"""Folders of results that are being written; who holds the lock of a part knows that nobody else writes to its own."""


def new_draft(work: Path, case_id: str) -> Path:
    """A folder for the files of a result."""
    return Path(tempfile.mkdtemp(prefix=f"{case_id[:8]}-{os.getpid()}-", dir=work))


def commit(draft: Path, out: Path, case_id: str, inputs: Sequence[Input], timings: Mapping[str, Any]) -> bool:
    """Put a draft in its place, with its manifest, by one rename; the second of two is discarded.

    Args:
        draft: Of `new_draft`, on the file system of ``out``, with all its files.
        out: The cohort's folder.
        case_id: The name of the result.
        inputs: Every file that decided it.
        timings: What differs from run to run: seconds, attempts.

    Returns:
        Whether it is this draft that is there now.
    """
    files = {path.name: file_digest(path) for path in sorted(draft.iterdir())}
    manifest = Manifest({ENTRY: ManifestEntry(version("puncture-twin"), tuple(inputs), (), files)})
    (draft / MANIFEST_NAME).write_text(manifest.text(), encoding="utf-8")
    stated = {"started": datetime.now(UTC).isoformat(timespec="seconds"), **timings}
    (draft / TIMINGS_NAME).write_text(json.dumps({ENTRY: stated}, indent=1, allow_nan=False) + "\n", encoding="utf-8")
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
    """Whether a case need not be run again."""
    return row is not None and row["exit_code"] != PROGRAM_FAILED


def discard(out: Path, case_id: str, work: Path) -> None:
    """Take a result away that is not final or not whole; it is gone at once, or it stays."""
    folder = out / case_id
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise InputError(f"{case_id} there is not a result of this cohort", where=out, allowed="a folder of its own")
    if folder.is_dir():
        gone = new_draft(work, case_id)
        folder.rename(gone / "old")
        shutil.rmtree(gone, ignore_errors=True)
