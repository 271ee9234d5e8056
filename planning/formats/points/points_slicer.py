"""Points of 3D Slicer: markups as JSON (.mrk.json), and the older fiducial lists (.fcsv).

Source: Slicer documentation, "Markups" module, file formats, and its published schema of versions 1.0.0 to 1.0.3;
in older files the coordinate system is a number. Version 1.0.0 knows no ``coordinateUnits``: Slicer works in mm.
"""

from __future__ import annotations

import csv
from typing import Any

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.input_file import decode_text
from puncture_twin.planning.base.strict_json import parse_json
from puncture_twin.planning.formats.points.raw_points import RawPoints, parse_coordinate
from puncture_twin.planning.formats.raw_mesh import refuse
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.geometry.units import Unit, parse_unit

_MARKUPS_ALLOWED = "one Slicer markup of type Fiducial or Line with labelled, defined control points"
_LINE_POINTS = 2
_SPACES = {"LPS": Space.LPS, "RAS": Space.RAS, "0": Space.RAS, "1": Space.LPS}
_FCSV_ALLOWED = "a Slicer fiducial list with '# CoordinateSystem = ' and '# columns = id,x,y,z,...,label,...'"
_FCSV_DEFINED = "2"
"""Slicer 5 writes two fields more than its header names: whether the position is defined (2), and one other."""
_FCSV_SYSTEM = "# coordinatesystem"
_FCSV_COLUMNS = "# columns"


def read_markups_points(data: bytes, where: str) -> RawPoints:
    """The control points of a Slicer markups file: a list of fiducials, or a line, each by its label.

    Which end of a line is the target no file says: the case names it by its label.

    Args:
        data: The whole file.
        where: Its name, for the error.

    Raises:
        InputError: If it is no such file, states no known space, or a point has no label or defined position.
    """
    tree = parse_json(data, where=where, allowed=_MARKUPS_ALLOWED)
    markups = tree.get("markups") if isinstance(tree, dict) else None
    if not isinstance(markups, list) or len(markups) != 1 or not isinstance(markups[0], dict):
        refuse("not exactly one entry in 'markups'", where, _MARKUPS_ALLOWED)
    markup = markups[0]
    points = _control_points(markup, where)
    places = [f"{where}, control point {number}" for number in range(1, len(points) + 1)]
    return RawPoints(
        names=[_label(point, place) for point, place in zip(points, places, strict=True)],
        points=[_position(point, place) for point, place in zip(points, places, strict=True)],
        unit=_unit(markup.get("coordinateUnits"), where),
        space=_space(markup.get("coordinateSystem"), where),
    )


def _control_points(markup: dict[str, Any], where: str) -> list[Any]:
    kind, points = markup.get("type", "Fiducial"), markup.get("controlPoints")
    if kind not in ("Fiducial", "Line"):
        refuse(f"markup of type {str(kind)[:40]!r}", where, _MARKUPS_ALLOWED)
    if not isinstance(points, list) or not points:
        refuse("no control point", where, _MARKUPS_ALLOWED)
    if kind == "Line" and len(points) != _LINE_POINTS:
        refuse(f"a line of {len(points)} control points", where, "both ends of a line: 2 control points")
    return points


def read_fcsv_points(data: bytes, where: str) -> RawPoints:
    """The points of an older Slicer fiducial list, which is in mm by its definition.

    Args:
        data: The whole file.
        where: Its name, for the error.

    Raises:
        InputError: If it states no known space or columns, or a line is not understood.
    """
    lines = decode_text(data, where).splitlines()
    system, header = _fcsv_value(lines, _FCSV_SYSTEM), _fcsv_value(lines, _FCSV_COLUMNS)
    columns = [] if header is None else [name.strip() for name in header.split(",")]
    if any(columns.count(name) != 1 for name in ("x", "y", "z", "label")):
        refuse(f"columns {columns}", where, _FCSV_ALLOWED)
    names, points = [], []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        place = f"{where}, line {number}"
        fields = _fcsv_fields(line, place)
        if len(fields) - len(columns) not in (0, 2):
            refuse(f"{len(fields)} fields instead of {len(columns)}", place, _FCSV_ALLOWED)
        if (status := (*fields, _FCSV_DEFINED)[len(columns)]) != _FCSV_DEFINED:
            refuse(f"position status {status[:40]!r}", place, f"{_FCSV_DEFINED} (defined)")
        names.append(fields[columns.index("label")].strip())
        x, y, z = (parse_coordinate(fields[columns.index(axis)], place) for axis in "xyz")
        points.append((x, y, z))
    return RawPoints(names, points, Unit.MM, _space(system, where))


def _space(value: object, where: str) -> Space:
    key = str(value).strip() if isinstance(value, (str, int)) and not isinstance(value, bool) else ""
    if key not in _SPACES:
        refuse(f"coordinate system {str(value)[:40]!r}", where, "LPS or RAS (in older files 1 or 0)")
    return _SPACES[key]


def _unit(value: object, where: str) -> Unit:
    """From "mm", or a coded entry such as ["mm", "UCUM", "millimeter"]; mm, the schema's default, if there is none."""
    if value is None:
        return Unit.MM
    text = value[0] if isinstance(value, list) and value else value
    if not isinstance(text, str):
        refuse(f"coordinateUnits {str(value)[:40]!r}", where, 'such as "mm" or ["mm", "UCUM", "millimeter"]')
    return parse_unit(text, where=where)


def _label(point: object, where: str) -> str:
    label = point.get("label") if isinstance(point, dict) else None
    if not isinstance(label, str) or not label.strip():
        refuse(f"label {str(label)[:40]!r}", where, "a label that is not empty")
    return label.strip()


def _position(point: dict[str, Any], where: str) -> tuple[float, float, float]:
    status = point.get("positionStatus", "defined")
    if status != "defined":
        refuse(f"positionStatus is {str(status)[:40]!r}", where, '"defined"')
    position = point.get("position")
    if not isinstance(position, list) or len(position) != 3:
        refuse(f"position {str(position)[:60]!r}", where, "three numbers")
    for value in position:
        if not isinstance(value, (int, float)) or isinstance(value, bool):
            refuse(f"position {str(position)[:60]!r}", where, "three numbers")
    x, y, z = (parse_coordinate(str(value), where) for value in position)
    return x, y, z


def _fcsv_value(lines: list[str], key: str) -> str | None:
    found = [line.partition("=")[2].strip() for line in lines if line.lower().startswith(key)]
    return found[0] if len(found) == 1 else None


def _fcsv_fields(line: str, where: str) -> list[str]:
    try:
        return next(csv.reader([line], strict=True))
    except csv.Error as error:
        raise InputError(f"{error}", where=where, allowed=_FCSV_ALLOWED) from error
