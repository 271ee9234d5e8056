"""A cohort as a CSV: the column ``case``, and columns of options."""

from __future__ import annotations

import csv
import io
import re
import tomllib
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.text_names import unprintable_texts
from puncture_twin.planning.batch.cohort.cohort_case import CohortCase
from puncture_twin.planning.case.options import SECTIONS, CaseOptions, case_options

CASE, NAME, TARGET = "case", "name", "target"
ALLOWED_COLUMNS = f"{CASE}, {NAME}, {TARGET}, and options as KIND.KEY (KIND one of {', '.join(SECTIONS)})"
LONGEST_CELL = 20_000


def csv_cases(content: bytes, path: Path) -> list[CohortCase]:
    """The cases that a CSV lists.

    Args:
        content: The whole file.
        path: Its name; cases are relative to its folder.

    Raises:
        InputError: No column ``case``, an unknown column, or a line that cannot be used; names the line.
    """
    rows = _rows(content, path)
    header = _header(next(rows, []), path)
    cases = []
    for row in rows:
        where = f"{path}: line {rows.line_num}"
        if not any(row):
            continue
        if len(row) != len(header):
            raise InputError(f"{len(row)} cells", where=where, allowed=f"{len(header)}, as in the header")
        cases.append(_case(dict(zip(header, row, strict=True)), path, where))
    return cases


def _rows(content: bytes, path: Path) -> Any:
    """The lines, as a reader that counts them."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"is not UTF-8 ({error})", where=path, allowed="a CSV in UTF-8") from error
    if "\0" in text or max(map(len, text.splitlines()), default=0) > LONGEST_CELL:
        raise InputError("is no CSV", where=path, allowed=f"text, lines of at most {LONGEST_CELL} characters")
    return csv.reader(io.StringIO(text), strict=False)


def _header(row: list[str], path: Path) -> list[str]:
    header = [cell.strip() for cell in row]
    if CASE not in header:
        raise InputError(f"has no column '{CASE}'", where=f"{path}: line 1", allowed=ALLOWED_COLUMNS)
    for name in header:
        kind, _, key = name.partition(".")
        if name not in (CASE, NAME, TARGET) and not (kind in SECTIONS and key):
            raise InputError(f"column '{name}' is not known", where=f"{path}: line 1", allowed=ALLOWED_COLUMNS)
        if header.count(name) > 1:
            raise InputError(f"column '{name}' stands twice", where=f"{path}: line 1", allowed="each column once")
    return header


def _case(cells: dict[str, str], path: Path, where: str) -> CohortCase:
    stated = cells[CASE]
    if not stated.strip() or any(unprintable_texts(cells)):
        raise InputError("has no case that can be printed", where=where, allowed="the path of a case")
    return CohortCase(stated, path.parent / stated.strip(), cells.get(NAME, "").strip(), _options(cells, where))


def _options(cells: dict[str, str], where: str) -> CaseOptions:
    sections: dict[str, dict[str, Any]] = {}
    if cells.get(TARGET, "").strip():
        sections["target"] = target_option(cells[TARGET].strip())
    for name, cell in cells.items():
        kind, _, key = name.partition(".")
        if key and cell.strip():
            sections.setdefault(kind, {})[key] = _value(cell.strip())
    return case_options(sections, where=where)


def target_option(text: str) -> dict[str, Any]:
    """Three numbers are a position in the case's space, mm; anything else is the name of a point."""
    parts = re.split(r"[\s,;]+", text.strip("[]() "))
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        return {"name": text}
    return {"position_mm": numbers} if len(numbers) == 3 else {"name": text}


def _value(cell: str) -> Any:
    """A cell as TOML reads it: a number, a list, a text in quotes; else it is a text as it stands."""
    try:
        return tomllib.loads(f"value = {cell}\n")["value"]
    except (tomllib.TOMLDecodeError, KeyError, RecursionError):
        return cell
