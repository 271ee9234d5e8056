"""Tables that say which label is which structure, as programs and people write them for a label map.

CSV with any common naming of its columns, JSON (``{"1": "liver"}``, ``{"liver": 1}``, nnU-Net's ``labels``), ITK-SNAP's
label descriptions and 3D Slicer's colour tables.
"""

from __future__ import annotations

import csv
import io
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import decode_text
from puncture_twin.planning.base.strict_json import parse_json
from puncture_twin.planning.formats.labels.labelmaps import MAX_LABEL

NAME_COLUMNS = (
    "name", "structurename", "labelname", "classname", "organname", "segmentname", "structure", "organ", "segment",
    "class", "anatomy", "description", "text", "label",
)  # fmt: skip
"""Headers of a column of names, the surest first; without spaces and signs."""
NUMBER_COLUMNS = (
    "id", "labelid", "classid", "segmentid", "structureid", "labelvalue", "value", "index", "idx", "number",
    "labelnumber", "label", "class", "key",
)  # fmt: skip
"""Headers of a column of numbers, the surest first."""
BACKGROUND = frozenset({"", "background", "clearlabel", "clear", "none", "unlabelled", "unlabeled", "air"})
"""Names of the background."""

ALLOWED_CSV = "a CSV with a header such as id,name or label,name, and one label per line"
ALLOWED_JSON = 'JSON such as {"1": "liver"}, {"liver": 1} or {"labels": {...}}'
ALLOWED_LIST = 'lines of ITK-SNAP (1 255 0 0 1 1 1 "liver") or of a colour table (1 liver 255 0 0 255)'


class _Entry(NamedTuple):
    number: str
    name: str
    where: str


def parse_names(data: bytes, path: Path) -> dict[int, str]:
    """The names of a table, by label.

    Raises:
        InputError: Not such a table, a label that stands twice, or none at all; names the line where there is one.
    """
    reader, allowed = _READERS[path.suffix.lower()]
    names: dict[int, str] = {}
    for entry in reader(data, path):
        label = _label(entry, allowed)
        if label is None:
            continue
        if label in names:
            refuse(f"id {label} appears twice", entry.where, "each id once", "duplicate_label")
        names[label] = entry.name.strip()
    if not names:
        refuse("the naming has no label", path, allowed, "empty")
    return names


def _label(entry: _Entry, allowed: str) -> int | None:
    """The number of an entry; None for the background."""
    text = entry.number.strip()
    if not (text.isascii() and text.isdigit() and len(text) < 7 and int(text) <= MAX_LABEL):
        refuse(f"label {text[:40]!r} of {entry.name[:60]!r}", entry.where, allowed, "bad_label")
    if int(text) == 0:
        if _plain(entry.name) not in BACKGROUND:
            refuse(f"label 0 is {entry.name[:60]!r}", entry.where, "0 for the background only", "bad_label")
        return None
    return int(text)


def _plain(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.lower())


def _csv_entries(data: bytes, path: Path) -> Iterator[_Entry]:
    rows = _rows(data, path)
    number, name = _columns(rows[0] if rows else [], path)
    for line, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        where = f"{path}, line {line}"
        if len(row) != len(rows[0]):
            refuse(f"{len(row)} fields, not {len(rows[0])}: {row}", where, ALLOWED_CSV, "ragged_row")
        yield _Entry(row[number], row[name], where)


def _rows(data: bytes, path: Path) -> list[list[str]]:
    text = decode_text(data, str(path))
    try:
        first = text.partition("\n")[0]
        separator = max((",", ";", "\t"), key=first.count)
        return list(csv.reader(io.StringIO(text, newline=""), strict=True, delimiter=separator))
    except csv.Error as error:
        raise InputError(f"is not a CSV file ({error})", where=path, allowed=ALLOWED_CSV, code="not_csv") from error


def _columns(header: Sequence[str], path: Path) -> tuple[int, int]:
    """Columns of numbers and names: ``label`` is a name next to an id, and a number next to a name."""
    plain = [_plain(cell) for cell in header]
    name = next((plain.index(one) for one in NAME_COLUMNS if one in plain), None)
    number = next((plain.index(one) for one in NUMBER_COLUMNS if one in plain and plain.index(one) != name), None)
    if name is None or number is None:
        shown = ",".join(header)[:100] or "missing"
        refuse(f"header {shown!r} has no column of labels and names", path, ALLOWED_CSV, "wrong_columns")
    return number, name


def _json_entries(data: bytes, path: Path) -> Iterator[_Entry]:
    tree = parse_json(data, where=path, allowed=ALLOWED_JSON)
    table = tree.get("labels", tree) if isinstance(tree, dict) else None
    if not isinstance(table, dict):
        refuse("not an object of labels", path, ALLOWED_JSON, "wrong_format")
    for key, value in table.items():
        number, name = (key, value) if isinstance(value, str) else (value, key)
        if isinstance(value, list):
            what = f"{str(key)[:60]!r} is a list of labels (a region): list its labels one by one"
            refuse(what, path, ALLOWED_JSON, "labels_of_regions")
        if isinstance(number, bool) or not isinstance(number, str | int) or not isinstance(name, str):
            refuse(f"entry {str(key)[:60]!r} is not a pair of a number and a name", path, ALLOWED_JSON, "wrong_format")
        yield _Entry(str(number), name, str(path))


def _list_entries(data: bytes, path: Path) -> Iterator[_Entry]:
    for line, text in enumerate(decode_text(data, str(path)).splitlines(), start=1):
        if text.strip() and not text.lstrip().startswith("#"):
            yield _list_entry(text, f"{path}, line {line}")


def _list_entry(text: str, where: str) -> _Entry:
    try:
        fields = shlex.split(text)
    except ValueError as error:
        raise InputError(f"{text[:60]!r} ({error})", where=where, allowed=ALLOWED_LIST, code="unknown_line") from error
    if len(fields) == 8 and all(_is_number(one) for one in fields[:7]):
        return _Entry(fields[0], fields[7], where)
    if len(fields) == 6 and all(_is_number(one) for one in fields[2:]):
        return _Entry(fields[0], fields[1], where)
    raise InputError(f"{text[:60]!r}", where=where, allowed=ALLOWED_LIST, code="unknown_line")


def _is_number(text: str) -> bool:
    return re.fullmatch(r"\d+(\.\d*)?|\.\d+", text) is not None


_Reader = Callable[[bytes, Path], Iterator[_Entry]]

_READERS: Mapping[str, tuple[_Reader, str]] = MappingProxyType(
    {
        ".csv": (_csv_entries, ALLOWED_CSV),
        ".tsv": (_csv_entries, ALLOWED_CSV),
        ".json": (_json_entries, ALLOWED_JSON),
        ".txt": (_list_entries, ALLOWED_LIST),
        ".ctbl": (_list_entries, ALLOWED_LIST),
    }
)
NAME_ENDINGS: tuple[str, ...] = tuple(_READERS)
"""Endings of files that may be such a table."""
