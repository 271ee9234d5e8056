"""What a cohort is made of: a folder, a CSV, or a TOML file with patterns and grids of options."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NoReturn

from puncture_twin.planning.base.errors import InputError, one_line
from puncture_twin.planning.base.files import is_folder
from puncture_twin.planning.base.input_file import read_input
from puncture_twin.planning.base.provenance import Input, content_input
from puncture_twin.planning.batch.cohort.cohort_case import MOST_CASES, CohortCase
from puncture_twin.planning.batch.cohort.cohort_csv import csv_cases
from puncture_twin.planning.batch.cohort.cohort_toml import toml_cases

CASE_FILE = "case.toml"
ALLOWED = f"a folder with {CASE_FILE} files, a CSV with the header 'case', or a cohort.toml"
MAX_FILE_BYTES = 200_000_000
"""A million lines of two hundred characters."""


def read_cohort(cohort: Path) -> tuple[tuple[CohortCase, ...], tuple[Input, ...]]:
    """The cases of a cohort, in its order, and the file that lists them, if one does.

    Args:
        cohort: A folder: every ``case.toml`` below it. A ``.csv`` or ``.toml`` file: what it lists.

    Raises:
        InputError: Something else, a file that cannot be read whole, or no case at all.
    """
    inputs: tuple[Input, ...] = ()
    if is_folder(cohort):
        cases = _folder_cases(cohort)
    else:
        cases, inputs = _listed_cases(cohort)
    if not 0 < len(cases) <= MOST_CASES:
        what = f"holds {len(cases)} cases" if cases else "holds no case"
        raise InputError(what, where=cohort, allowed=f"1 to {MOST_CASES} cases: {ALLOWED}")
    for one in cases:
        _check_path(one, cohort)
    return tuple(cases), inputs


def _check_path(case: CohortCase, cohort: Path) -> None:
    """Refuse a path that no table can hold: a case that cannot be named would be lost."""
    try:
        str(case.path.absolute()).encode("utf-8")
    except UnicodeEncodeError as error:
        what = f"the path '{one_line(case.stated, 100)}' is no UTF-8"
        raise InputError(what, where=cohort, allowed="cases whose paths are UTF-8") from error


def _listed_cases(path: Path) -> tuple[list[CohortCase], tuple[Input, ...]]:
    readers = {".csv": csv_cases, ".toml": toml_cases}
    if path.suffix.lower() not in readers:
        raise InputError("is no cohort", where=path, allowed=ALLOWED)
    content = read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path))
    return readers[path.suffix.lower()](content, path), (content_input("cohort", path.name, content),)


def _folder_cases(cohort: Path) -> list[CohortCase]:
    """Every case file below a folder, also behind links to folders, each folder once; none that cannot be looked into.

    Raises:
        InputError: A folder that cannot be read, or a link to nothing beside folders: a patient would be lost.
    """
    found, seen = [], set[str]()
    for folder, below, files in os.walk(cohort, followlinks=True, onerror=_refuse_unreadable):
        real = os.path.realpath(folder)
        if real in seen:
            below.clear()
            continue
        seen.add(real)
        below.sort()
        if CASE_FILE in files:
            path = Path(folder) / CASE_FILE
            found.append(CohortCase(path.relative_to(cohort).as_posix(), path))
        elif below and (lost := [one for one in files if not (Path(folder) / one).exists()]):
            _refuse(f"'{one_line(lost[0], 100)}' is a link to what is not there", folder)
    return sorted(found, key=lambda one: one.stated)


def _refuse_unreadable(error: OSError) -> NoReturn:
    _refuse(f"cannot be read ({error.strerror})", str(error.filename))


def _refuse(what: str, where: str) -> NoReturn:
    raise InputError(what, where=where, allowed="folders of patients that can be read", code="cohort_not_whole")
