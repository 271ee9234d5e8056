"""Points as CSV: a header with the unit in it, then one point per line."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from typing import NamedTuple

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.input_file import decode_text
from puncture_twin.planning.formats.joint_readings import JOINTS_DEG, row_numbers
from puncture_twin.planning.formats.points.raw_points import RawPoints, parse_coordinate
from puncture_twin.planning.formats.raw_mesh import refuse
from puncture_twin.planning.geometry.units import Unit, parse_unit

_ALLOWED = (
    "a header name,x_mm,y_mm,z_mm (or _cm, _m; kind, and q1_deg to q6_deg, may be added), "
    "then as many fields in every line"
)


class _Row(NamedTuple):
    line: int
    fields: list[str]


def read_csv_points(data: bytes, where: str) -> RawPoints:
    """The points of a CSV file, in the order of its lines; empty lines are passed over.

    Args:
        data: The whole file.
        where: Its name, for the error.

    Raises:
        InputError: If the header or a line is not understood; the error names the line.
    """
    rows = list(_rows(data, where))
    if not rows:
        refuse("no line", where, _ALLOWED)
    header = [field.strip() for field in rows[0].fields]
    unit = _unit(header, where)
    columns = {name.partition("_")[0]: index for index, name in enumerate(header)}
    for line, fields in rows[1:]:
        if len(fields) != len(header):
            refuse(f"{len(fields)} fields instead of {len(header)}", f"{where}, line {line}", _ALLOWED)
        if not fields[columns["name"]].strip():
            refuse("empty name", f"{where}, line {line}", _ALLOWED)
    points = [
        tuple(parse_coordinate(fields[columns[axis]], f"{where}, line {line}") for axis in "xyz")
        for line, fields in rows[1:]
    ]
    return RawPoints(
        names=[fields[columns["name"]].strip() for _, fields in rows[1:]],
        points=[(x, y, z) for x, y, z in points],
        unit=unit,
        space=None,
        kinds=tuple(f[columns["kind"]].strip() for _, f in rows[1:]) if "kind" in columns else None,
        joints_deg=[
            tuple(row_numbers(fields, header, JOINTS_DEG, f"{where}, line {line}")) for line, fields in rows[1:]
        ]
        if "q1" in columns
        else None,
    )


def _rows(data: bytes, where: str) -> Iterator[_Row]:
    reader = csv.reader(io.StringIO(decode_text(data, where), newline=""), strict=True)
    try:
        for fields in reader:
            if any(field.strip() for field in fields):
                yield _Row(reader.line_num, fields)
    except csv.Error as error:
        raise InputError(f"{error}", where=f"{where}, line {reader.line_num}", allowed=_ALLOWED) from error


def _unit(header: list[str], where: str) -> Unit | None:
    """The one unit of the three coordinate columns, None if they have none."""
    units: dict[str, str] = {}
    for name in header:
        axis = re.fullmatch(r"([xyz])(?:_(\w+))?", name)
        if axis:
            units[axis[1]] = axis[2] or ""
        elif name not in ("name", "kind", *JOINTS_DEG):
            refuse(f"column {name[:40]!r}", f"{where}, header", _ALLOWED)
    if len(set(header)) != len(header) or sorted(units) != ["x", "y", "z"] or "name" not in header:
        refuse(f"columns {header}", f"{where}, header", _ALLOWED)
    joints = sum(name in JOINTS_DEG for name in header)
    if joints not in (0, 6) or len(header) != 4 + ("kind" in header) + joints:  # such as x_mm beside x_m
        refuse(f"columns {header}", f"{where}, header", _ALLOWED)
    if len(set(units.values())) != 1:
        refuse(f"mixed units {sorted(set(units.values()))}", f"{where}, header", _ALLOWED)
    text = units["x"]
    return parse_unit(text, where=f"{where}, header") if text else None
