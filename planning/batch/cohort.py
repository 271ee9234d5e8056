"""The cases of a cohort: a folder, a CSV, or a TOML file with patterns of cases and a grid of options for each."""

import glob
import math
import os
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, NoReturn

from pydantic import Field

from puncture_twin.planning.base.errors import InputError, one_line, refuse
from puncture_twin.planning.base.files import is_folder, read_input
from puncture_twin.planning.base.provenance import Input, content_input
from puncture_twin.planning.base.text import unprintable_texts
from puncture_twin.planning.base.toml_file import SchemaOne, parse_toml
from puncture_twin.planning.case.case_file import NO_OPTIONS, SECTIONS, CaseOptions, case_options
from puncture_twin.planning.case.tables import Section, Text
from puncture_twin.planning.formats.csv_table import CsvLine, csv_lines

CASE_FILE = "case.toml"
ALLOWED = f"a folder with {CASE_FILE} files, a CSV with the header 'case', or a cohort.toml"
READABLE = "readable folders of patients"
MAX_FILE_BYTES = 200_000_000
MOST_CASES = 1_000_000
"""A million lines of two hundred characters. More cases of one cohort are a slip in a grid of options."""


@dataclass(frozen=True)
class CohortCase:
    """One case with its options: its file, or the folder that holds ``case.toml``; "" leaves the name to the case."""

    stated: str
    path: Path
    name: str = ""
    options: CaseOptions = NO_OPTIONS


def read_cohort(cohort: Path) -> tuple[tuple[CohortCase, ...], tuple[Input, ...]]:
    """The cases of a cohort (a folder, a ``.csv`` or ``.toml`` file), in its order, and the file that lists them.

    Raises InputError: something else, a file that cannot be read whole, or no case at all.
    """
    inputs, readers = tuple[Input, ...](), {".csv": csv_cases, ".toml": toml_cases}
    if is_folder(cohort):
        cases = _folder_cases(cohort)
    elif cohort.suffix.lower() in readers:
        content = read_input(cohort, max_bytes=MAX_FILE_BYTES, where=str(cohort))
        cases = readers[cohort.suffix.lower()](content, cohort)
        inputs = (content_input("cohort", cohort.name, content),)
    else:
        refuse("is not a cohort", cohort, ALLOWED, "not_a_cohort")
    if not 0 < len(cases) <= MOST_CASES:
        what = f"has {len(cases)} cases" if cases else "has no case"
        refuse(what, cohort, f"1 to {MOST_CASES} cases: {ALLOWED}", "cohort_size")
    for one in cases:  # no table can hold another path: a case that cannot be named would be lost
        try:
            str(one.path.absolute()).encode("utf-8")
        except UnicodeEncodeError as error:
            what = f"the path '{one_line(one.stated, 100)}' is not UTF-8"
            raise InputError(what, where=cohort, allowed="cases with UTF-8 paths", code="not_text") from error
    return tuple(cases), inputs


def _folder_cases(cohort: Path) -> list[CohortCase]:
    """Every case file below a folder, also behind links to folders, each folder once.

    What cannot be read, or a link to nothing next to folders, is refused: a patient would be lost.
    """
    cases, seen = [], set[str]()
    for folder, below, files in os.walk(cohort, followlinks=True, onerror=_refuse_unreadable):
        real = os.path.realpath(folder)
        if real in seen:
            below.clear()
            continue
        seen.add(real)
        below.sort()
        if CASE_FILE in files:
            path = Path(folder) / CASE_FILE
            cases.append(CohortCase(path.relative_to(cohort).as_posix(), path))
        elif below and (lost := [one for one in files if not (Path(folder) / one).exists()]):
            refuse(f"'{one_line(lost[0], 100)}' is a broken link", folder, READABLE, "cohort_not_whole")
    return sorted(cases, key=lambda one: one.stated)


def _refuse_unreadable(error: OSError) -> NoReturn:
    refuse(f"cannot be read ({error.strerror})", str(error.filename), READABLE, "cohort_not_whole")


CASE, NAME, TARGET = "case", "name", "target"
LONGEST_CELL = 20_000
ALLOWED_COLUMNS = f"{CASE}, {NAME}, {TARGET}, and options as KIND.KEY (KIND one of {', '.join(SECTIONS)})"


def csv_cases(content: bytes, path: Path) -> list[CohortCase]:
    """The cases that a CSV lists; what cannot be used is refused with its line. # is no comment: a path may have it."""
    lines = csv_lines(content, str(path), ALLOWED_COLUMNS, mark=None)
    header = _header(next(lines, CsvLine(1, [])), path)
    cases = []
    for line, row in lines:
        where = f"{path}: line {line}"
        if max(map(len, row)) > LONGEST_CELL:
            refuse("is not a CSV file", where, f"text, cells of at most {LONGEST_CELL} characters", "not_csv")
        if len(row) != len(header):
            refuse(f"{len(row)} cells", where, f"{len(header)}, as in the header", "ragged_row")
        cases.append(_case(dict(zip(header, row, strict=True)), path, where))
    return cases


def _header(line: CsvLine, path: Path) -> list[str]:
    header, where = [cell.strip() for cell in line.fields], f"{path}: line {line.line}"
    if CASE not in header:
        refuse(f"has no column '{CASE}'", where, ALLOWED_COLUMNS, "missing_column")
    for name in header:
        kind, _, key = name.partition(".")
        if name not in (CASE, NAME, TARGET) and not (kind in SECTIONS and key):
            refuse(f"column '{name}' is not known", where, ALLOWED_COLUMNS, "unknown_column")
        if header.count(name) > 1:
            refuse(f"column '{name}' appears twice", where, "each column once", "duplicate_column")
    return header


def _case(cells: dict[str, str], path: Path, where: str) -> CohortCase:
    stated = cells[CASE]
    if not stated.strip() or any(unprintable_texts(cells)):
        refuse("the case is empty or not printable", where, "the path of a case", "bad_name")
    sections: dict[str, dict[str, Any]] = {}
    if cells.get(TARGET, "").strip():
        sections["target"] = target_option(cells[TARGET].strip())
    for name, cell in cells.items():
        kind, _, key = name.partition(".")
        if key and cell.strip():
            sections.setdefault(kind, {})[key] = _value(cell.strip())
    options = case_options(sections, where=where)
    return CohortCase(stated, path.parent / stated.strip(), cells.get(NAME, "").strip(), options)


def target_option(text: str) -> dict[str, Any]:
    """Three numbers are a position in the case's space, mm; anything else is the name of a point."""
    parts = re.split(r"[\s,;]+", text.strip("[]() "))
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        return {"name": text}
    return {"position_mm": numbers} if len(numbers) == 3 else {"name": text}


def _value(cell: str) -> Any:
    """A cell as TOML reads it: a number, a list, a text in quotes; else its own text."""
    try:
        return tomllib.loads(f"value = {cell}\n")["value"]
    except (tomllib.TOMLDecodeError, KeyError, RecursionError):
        return cell


ALLOWED_TOML = "a cohort.toml with cases = [patterns] and, if wanted, tables of options"
KEYS = "docs/how-to/cohorts.md"
Choices = dict[Text, dict[str, Any]] | tuple[Any, ...]
"""Options of one kind: by name, or as a list: texts are their own names, the rest is counted from 1."""
AXES = {
    "targets": "target", "margins": "margins", "mounts": "mount", "needles": "needle", "arms": "arm",
    "errors": "errors",
}  # fmt: skip
"""Table of the cohort to the kind of its options."""


class CohortFile(Section):
    """Schema of a whole ``cohort.toml``."""

    schema_: SchemaOne = Field(1, alias="schema")
    cases: Annotated[tuple[Text, ...], Field(min_length=1)]
    targets: Choices = ()
    margins: Choices = ()
    mounts: Choices = ()
    needles: Choices = ()
    arms: Choices = ()
    errors: Choices = ()


def toml_cases(content: bytes, path: Path) -> list[CohortCase]:
    """The cases that a cohort file describes: every match of its patterns with every combination of its options."""
    stated = parse_toml(content, path, CohortFile, allowed=ALLOWED_TOML, keys=KEYS)
    paths = _matches(stated.cases, path)
    axes = [axis for name, kind in AXES.items() if (axis := _axis(getattr(stated, name), name, kind, path))]
    count = len(paths) * math.prod(len(axis) for axis in axes)
    if count > MOST_CASES:
        refuse(f"gives {count} cases", path, f"at most {MOST_CASES}", "cohort_size")
    combinations = []
    for choices in product(*axes):
        name = ", ".join(f"{kind} {name}" for kind, name, _ in choices)
        options = case_options({kind: dict(values) for kind, _, values in choices}, where=str(path))
        combinations.append((name, options))
    return [CohortCase(one, path.parent / one, name, options) for one in paths for name, options in combinations]


def _matches(patterns: Sequence[str], path: Path) -> list[str]:
    """Matches of the patterns, each once, in the order of the patterns."""
    paths: dict[str, None] = {}
    for pattern in patterns:
        matches = sorted(glob.glob(pattern, root_dir=path.parent, recursive=True))  # noqa: PTH207  # absolute ones too
        if not matches:
            refuse(f"cases '{pattern}' matches nothing", path, "patterns of existing cases", "no_match")
        paths |= dict.fromkeys(matches)
    return list(paths)


def _axis(stated: Any, axis: str, kind: str, path: Path) -> list[tuple[str, str, Mapping[str, Any]]]:
    """Kind, name and values of each choice."""
    if isinstance(stated, Mapping):
        named = list(stated.items())
    else:
        named = [(one if isinstance(one, str) else str(number), one) for number, one in enumerate(stated, start=1)]
    return [(kind, name, _table(values, kind, f"{path}: {axis}.{name}")) for name, values in named]


def _table(values: Any, kind: str, where: str) -> Mapping[str, Any]:
    """The option's table of the case file; of a target a point, of an arm its model, without the key."""
    if isinstance(values, Mapping):
        return values
    if kind == "target" and isinstance(values, list | tuple):
        return {"position_mm": list(values)}
    if kind == "arm" and isinstance(values, str):
        return {"model": values}
    what = f"option '{kind}' is not a table"
    raise InputError(what, where=where, allowed="keys and values, as in the case", code="not_a_table")
