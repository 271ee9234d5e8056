"""A list of directions in a file: points of entry, or angles; each row one direction."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import NamedTuple

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.input_file import decode_text, read_input, unfinished_warnings
from puncture_twin.planning.base.provenance import Input, content_input
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.points.point_files import MAX_FILE_BYTES, parse_points
from puncture_twin.planning.formats.points.raw_points import parse_coordinate
from puncture_twin.planning.geometry.spaces import to_lps
from puncture_twin.planning.search.selection.choice import Choice, parse_choice

ANGLES = ("theta_deg", "beta_deg")
ALLOWED_ANGLES = "a header with theta_deg and beta_deg, and perhaps name; then as many fields in every line"
GREATEST = (180.0, 360.0)
"""Of the two angles, degrees."""


class Listed(NamedTuple):
    """One row.

    Attributes:
        number: 1 for the first.
        name: As the file states it; "" without one.
        point_mm: Where it states a point: in the case's space, mm.
        choice: The direction; of a list of targets, whatever was chosen for all.
    """

    number: int
    name: str
    point_mm: tuple[float, float, float] | None
    choice: Choice


class ReadList(NamedTuple):
    """A file's rows, the file, and what is odd about it."""

    rows: tuple[Listed, ...]
    input: Input
    warnings: tuple[str, ...]


def read_entries(path: Path, case: Case) -> ReadList:
    """Entries as points (CSV in the case's space, or Slicer's lists), or a CSV of angles.

    Raises:
        InputError: A file that cannot be read, or a line that is none; names the line.
    """
    data = read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path))
    source = content_input("entries", str(path), data)
    if path.suffix.lower() == ".csv" and set(ANGLES) & set(_header(data, path)):
        return ReadList(_angle_rows(data, path), source, _unfinished(data, path))
    rows = _points(data, path, case)
    rows = tuple(one._replace(choice=Choice(entry_mm=one.point_mm)) for one in rows)
    return ReadList(rows, source, _unfinished(data, path))


def read_targets(path: Path, case: Case, choice: Choice) -> ReadList:
    """Targets as points, in the case's space or in the file's own; the same choice for each.

    Raises:
        InputError: See `read_entries`.
    """
    data = read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path))
    rows = tuple(one._replace(choice=choice) for one in _points(data, path, case))
    return ReadList(rows, content_input("targets", str(path), data), _unfinished(data, path))


def _unfinished(data: bytes, path: Path) -> tuple[str, ...]:
    """Of a list that is read line by line and may be cut within a number."""
    return unfinished_warnings(data, path.name) if path.suffix.lower() in (".csv", ".fcsv") else ()


def _points(data: bytes, path: Path, case: Case) -> tuple[Listed, ...]:
    listed = parse_points(data, path, default_space=case.space)
    typed = to_lps(listed.points, case.space).tolist()  # the change of signs undoes itself
    named = enumerate(zip(listed.names, typed, strict=True), start=1)
    return tuple(Listed(number, name, (x, y, z), Choice()) for number, (name, (x, y, z)) in named)


def _header(data: bytes, path: Path) -> list[str]:
    lines = decode_text(data, str(path)).splitlines()
    return [field.strip() for field in (lines[0] if lines else "").split(",")]


def _angle_rows(data: bytes, path: Path) -> tuple[Listed, ...]:
    header = _header(data, path)
    if sorted(header) not in (sorted(ANGLES), sorted((*ANGLES, "name"))):
        raise InputError(f"columns {header}"[:200], where=f"{path}, header", allowed=ALLOWED_ANGLES)
    reader = csv.reader(io.StringIO(decode_text(data, str(path)), newline=""), strict=True)
    rows: list[Listed] = []
    try:
        next(reader)
        for fields in reader:
            if any(field.strip() for field in fields):
                where = f"{path}, line {reader.line_num}"
                rows.append(_angle_row(len(rows) + 1, header, fields, where))
    except csv.Error as error:
        raise InputError(f"{error}", where=f"{path}, line {reader.line_num}", allowed=ALLOWED_ANGLES) from error
    if not rows:
        raise InputError("no line", where=path, allowed=ALLOWED_ANGLES)
    return tuple(rows)


def _angle_row(number: int, header: list[str], fields: list[str], where: str) -> Listed:
    if len(fields) != len(header):
        raise InputError(f"{len(fields)} fields instead of {len(header)}", where=where, allowed=ALLOWED_ANGLES)
    stated = dict(zip(header, (field.strip() for field in fields), strict=True))
    theta, beta = (parse_coordinate(stated[name], where) for name in ANGLES)
    for name, angle, most in zip(ANGLES, (theta, beta), GREATEST, strict=True):
        if not 0.0 <= angle <= most:
            raise InputError(f"{name} {angle:g}", where=where, allowed=f"0 to {most:g}")
    return Listed(number, stated.get("name", ""), None, parse_choice(theta, beta, None, None, None))
