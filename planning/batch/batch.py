"""Many cases, one after the other or in processes of this machine; one that fails does not stop the others."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.base.errors import InputError, PlanningError, one_line
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.processes import process_pool
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.base.provenance import inputs_document, read_inputs
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.table import write_table

COLUMNS = (
    "case",
    "name",
    "folder",
    "exit_code",
    "directions",
    "safe",
    "best_theta_deg",
    "best_beta_deg",
    "said",
    "inputs",
)
"""Columns of ``batch.csv``; ``inputs`` is the list of role, path and sha256 as JSON, empty where a case was refused.
How long a case took is in ``timings.json``: the table is reproducible."""


def run_batch(
    cases: Sequence[Path], out: Path, *, jobs: int, arm: bool | None, watcher: Watcher
) -> list[dict[str, Any]]:
    """Search every case; write ``0001/candidates.parquet`` and so on, and ``batch.csv`` for all.

    Args:
        cases: Case files or folders.
        out: Folder for the results.
        jobs: Processes, at most one a core; each case runs in one.
        arm: Whether the arm is checked too, see `prepare`.
        watcher: Whoever shows progress, in cases.

    Returns:
        One row per case, in the order given, with the keys `COLUMNS` and ``seconds``; ``exit_code`` as the command
        line's.
    """
    rows: list[dict[str, Any]] = [{} for _ in cases]
    seconds: dict[str, float] = {}
    tables = [f"{folder_name(number)}/candidates.parquet" for number in range(1, len(cases) + 1)]
    with writing(out, "batch", seconds=seconds, names=["batch.csv", *tables], note=watcher.note) as draft:
        for number, row in _searched(cases, draft.folder, jobs, arm, watcher):
            rows[number] = row
        draft.inputs = [
            replace(one, role=f"{row['folder']} {one.role}") for row in rows for one in read_inputs(row["inputs"] or [])
        ]
        seconds |= {row["folder"]: row["seconds"] or 0.0 for row in rows}
        with atomic(draft.folder / "batch.csv") as temporary:
            _write_rows(rows, temporary)
    return rows


def folder_name(number: int) -> str:
    """Of the case of this number, from 1 on."""
    return f"{number:04d}"


def _searched(
    cases: Sequence[Path], out: Path, jobs: int, arm: bool | None, watcher: Watcher
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Each case's number and row, as they are done."""
    folders = [out / folder_name(number) for number in range(1, len(cases) + 1)]
    with process_pool(jobs, len(cases)) as pool:
        numbers = {
            pool.submit(search_one, case, folder, arm): number
            for number, (case, folder) in enumerate(zip(cases, folders, strict=True))
        }
        for done, future in enumerate(as_completed(numbers), start=1):
            number, failed = numbers[future], future.exception()
            yield number, future.result() if failed is None else _failed(cases[number], folders[number].name, failed)
            watcher.count("cases", done, len(cases))


def _write_rows(rows: Sequence[dict[str, Any]], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows({**row, "inputs": json.dumps(row["inputs"] or [])} for row in rows)


def _failed(path: Path, folder: str, error: BaseException) -> dict[str, Any]:
    """The row of a case at which the program itself failed."""
    row: dict[str, Any] = dict.fromkeys((*COLUMNS, "seconds"))
    said = f"{type(error).__name__}: {error}"
    return row | {
        "case": one_line(str(path)),
        "folder": folder,
        "directions": 0,
        "safe": 0,
        "exit_code": 3,
        "said": " ".join(said.split()),
    }


def search_one(path: Path, out: Path, arm: bool | None) -> dict[str, Any]:
    """Search one case and write its table; a refusal becomes a row."""
    row: dict[str, Any] = dict.fromkeys((*COLUMNS, "seconds"))
    row |= {"case": one_line(str(path)), "folder": out.name, "directions": 0, "safe": 0}
    try:
        context = prepare(path, arm=arm)
        found = context.search()
    except PlanningError as error:
        return row | {"exit_code": 2 if isinstance(error, InputError) else 3, "said": str(error)}
    write_table(found, context.provenance(), out / "candidates.parquet")
    row |= {"name": context.case.name, "directions": len(found), "safe": int(found.safe.sum())}
    row["inputs"] = inputs_document(context.case.inputs)
    row["seconds"] = sum(context.stages.seconds.values())
    if not found.safe.any():
        return row | {"exit_code": 1, "said": "no safe candidate"}
    best = int(found.ranked[0])
    angles = {"best_theta_deg": np.degrees(found.theta[best]), "best_beta_deg": np.degrees(found.beta[best])}
    said = "done" if found.arm_checked else f"done for the organs; arm {found.arm_note}"
    return row | {"exit_code": 0, "said": said} | {key: float(value) for key, value in angles.items()}
