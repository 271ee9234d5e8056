"""Named points and joint recordings of other programs: CSV, Slicer markups (.mrk.json) and older Slicer lists (.fcsv).

A CSV states its unit in the header (``name,x_mm,y_mm,z_mm``) and leaves the space to the case; Slicer's files state
both. Whatever states a patient space arrives in LPS, in mm. Source: Slicer documentation, "Markups" module, file
formats, and its published schema of versions 1.0.0 to 1.0.3; in older files the coordinate system is a number. Version
1.0.0 knows no ``coordinateUnits``: Slicer works in mm.
`joint_readings` is the one gate for joint angles: whose arm they are of is checked in `planning/arm/kinematics.py`.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import atomic, decode_text, read_input
from puncture_twin.planning.base.strict_json import parse_json
from puncture_twin.planning.base.text import Facts, Shown, brief
from puncture_twin.planning.formats.csv_table import csv_lines, parse_coordinate, row_numbers
from puncture_twin.planning.formats.guard import guard_points
from puncture_twin.planning.geometry.spaces import Space, Unit, parse_unit, to_lps


@dataclass(frozen=True, eq=False)
class NamedPoints(Shown):
    """Points with names, as guarded: finite, at least one, every name once."""

    names: tuple[str, ...]
    """Shape (n,), in the order of the file."""
    points: NDArray[np.float64]
    """Shape (n, 3), mm, read-only, in ``space``."""
    space: Space | None
    """LPS for patient data, LOCAL for a frame of its own, None where it is not stated (such as a robot's base)."""
    kinds: tuple[str, ...] | None = None
    """Shape (n,), what each point is, where the file says so ("marker", "lesion")."""
    joints: NDArray[np.float64] | None = None
    """Shape (n, 6), rad, read-only: how the robot stood at the touch of each, where the file says so."""

    def _facts(self) -> Facts:
        yield "space", str(self.space or "not stated")
        for name, (x, y, z) in zip(self.names, self.points, strict=True):
            yield name, f"({x:.2f}, {y:.2f}, {z:.2f}) mm"

    @brief
    def __repr__(self) -> str:
        named = ", ".join(self.names[:MOST_NAMED]) + (", ..." if len(self.names) > MOST_NAMED else "")
        return f"{len(self.names)} points, {self.space or 'no space stated'}: {named}"

    def __post_init__(self) -> None:
        for name in ("points", "joints"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, read_only(getattr(self, name)))


MAX_FILE_BYTES = 10_000_000
"""A hundred thousand points; a larger file is no list of markers."""
MOST_NAMED = 8
"""Points that a line about a list names."""


def read_points(path: Path, *, default_space: Space | None = None, default_unit: Unit | None = None) -> NamedPoints:
    """The points of one file, in mm; in LPS where the file or the caller names a patient space.

    ``default_space``, ``default_unit``: of a file that states none; the case's space, or None for a robot's base. None
    for the unit refuses such a file.
    """
    _reader(path, str(path))  # an unknown ending is refused before anything is read
    data = read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path))
    return parse_points(data, path, default_space=default_space, default_unit=default_unit)


def parse_points(
    data: bytes, path: Path, *, default_space: Space | None = None, default_unit: Unit | None = None
) -> NamedPoints:
    """Parse a points file that has been read, as `read_points` does; it is not opened again."""
    name = str(path)
    raw = _reader(path, name)(data, name)
    unit = raw.unit or default_unit
    if unit is None:
        refuse("no unit of length", name, "x_mm,y_mm,z_mm in the header", "unit_not_stated")
    if raw.space is not None and default_space is Space.LOCAL:
        message = f"points in {raw.space}, but the case has a local frame"
        refuse(message, name, "points in the case's own space, as CSV", "local_space")
    space = raw.space or default_space
    points = np.array(raw.points, dtype=np.float64).reshape(-1, 3)
    with np.errstate(over="ignore"):  # beyond the range of floats is infinite, which the guard refuses
        points = points * unit.mm if space is None else to_lps(points, space) * unit.mm
    guarded = guard_points(points, raw.names, where=name)
    stated = raw.joints_deg
    joints = None if stated is None else joint_readings(stated, "deg", where=name, names=raw.names)
    return NamedPoints(tuple(raw.names), guarded, Space.LPS if space is Space.RAS else space, raw.kinds, joints)


def _reader(path: Path, where: str) -> Callable[[bytes, str], RawPoints]:
    reader = next((read for suffix, read in _READERS.items() if path.name.lower().endswith(suffix)), None)
    if reader is None:
        refuse(f"unknown point file {path.name!r}", where, ", ".join(_READERS), "unknown_format")
    return reader


def write_points(path: Path, points: NamedPoints) -> None:
    """Write a CSV ``name,x_mm,y_mm,z_mm`` and joints, whole, in the space of its case; it reads back the same.

    Raises InputError: the place cannot be written to.
    """
    header = ["name", *(["kind"] if points.kinds else []), "x_mm", "y_mm", "z_mm"]
    header += [] if points.joints is None else JOINTS_DEG
    labels = zip(points.names, points.kinds, strict=True) if points.kinds else ((name,) for name in points.names)
    numbers = points.points if points.joints is None else np.hstack([points.points, np.degrees(points.joints)])
    rows = [[*label, *row] for label, row in zip(labels, numbers.tolist(), strict=True)]
    hidden = any(name.lstrip().startswith("#") for name in points.names)  # without quotes such a row is a comment
    with atomic(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        quoted = csv.writer(file, lineterminator="\n", quoting=csv.QUOTE_NONNUMERIC)
        (quoted if hidden else csv.writer(file, lineterminator="\n")).writerows([header, *rows])


def parse_triple(text: str, where: str, allowed: str = "X,Y,Z in mm") -> tuple[float, float, float]:
    """Three numbers as they are typed, with commas between. Raises InputError: more or fewer, or none finite."""
    numbers = [parse_coordinate(part.strip(), where) for part in text.split(",")]
    if len(numbers) != 3:
        refuse(f"{len(numbers)} numbers", where, allowed, "wrong_count")
    return numbers[0], numbers[1], numbers[2]


class RawPoints(NamedTuple):
    """Points as their file states them; the guard has not seen them yet."""

    names: list[str]
    points: list[tuple[float, float, float]]  # three coordinates per point, in ``unit`` and ``space``
    unit: Unit | None  # None if the file states none
    space: Space | None  # None if the file states none
    kinds: tuple[str, ...] | None = None  # one per point, if the file has them
    joints_deg: list[tuple[float, ...]] | None = None  # six angles per point, if it says how the robot stood there


_ALLOWED = (
    "a header name,x_mm,y_mm,z_mm (or _cm, _m; kind, and q1_deg to q6_deg, may be added), "
    "then as many fields in every line"
)


def read_csv_points(data: bytes, where: str) -> RawPoints:
    """The points of a CSV file, in the order of its lines."""
    rows = list(csv_lines(data, where, _ALLOWED, named=True))
    if not rows:
        refuse("no line", where, _ALLOWED, "empty")
    header = [field.strip() for field in rows[0].fields]
    units: dict[str, str] = {}
    for name in header:
        axis = re.fullmatch(r"([xyz])(?:_(\w+))?", name)
        if axis:
            units[axis[1]] = axis[2] or ""
        elif name not in ("name", "kind", *JOINTS_DEG):
            refuse(f"column {name[:40]!r}", f"{where}, header", _ALLOWED, "unknown_column")
    if len(set(header)) != len(header) or sorted(units) != ["x", "y", "z"] or "name" not in header:
        refuse(f"columns {header}", f"{where}, header", _ALLOWED, "wrong_columns")
    joints = sum(name in JOINTS_DEG for name in header)
    if joints not in (0, 6) or len(header) != 4 + ("kind" in header) + joints:  # such as x_mm beside x_m
        refuse(f"columns {header}", f"{where}, header", _ALLOWED, "wrong_columns")
    if len(set(units.values())) != 1:
        refuse(f"mixed units {sorted(set(units.values()))}", f"{where}, header", _ALLOWED, "mixed_units")
    unit = parse_unit(units["x"], where=f"{where}, header") if units["x"] else None
    columns = {name.partition("_")[0]: index for index, name in enumerate(header)}
    placed = [(f"{where}, line {line}", fields) for line, fields in rows[1:]]
    for place, fields in placed:
        if len(fields) != len(header):
            refuse(f"{len(fields)} fields instead of {len(header)}", place, _ALLOWED, "ragged_row")
        if not fields[columns["name"]].strip():
            refuse("the name is empty", place, _ALLOWED, "bad_name")
    names, points = [fields[columns["name"]].strip() for _, fields in placed], []
    for place, fields in placed:
        x, y, z = (parse_coordinate(fields[columns[axis]], place) for axis in "xyz")
        points.append((x, y, z))
    kinds = tuple(fields[columns["kind"]].strip() for _, fields in placed) if "kind" in columns else None
    turned = [tuple(row_numbers(fields, header, JOINTS_DEG, place)) for place, fields in placed] if joints else None
    return RawPoints(names, points, unit, None, kinds, turned)


_MARKUPS_ALLOWED = "one Slicer markup of type Fiducial or Line with labelled, defined control points"
_SPACES = {"LPS": Space.LPS, "RAS": Space.RAS, "0": Space.RAS, "1": Space.LPS}
_FCSV_ALLOWED = "a Slicer fiducial list with '# CoordinateSystem = ' and '# columns = id,x,y,z,...,label,...'"
_FCSV_DEFINED = "2"
"""Slicer 5 writes two fields more than its header names: whether the position is defined (2), and one other."""
_FCSV_SYSTEM = "# coordinatesystem"
_FCSV_COLUMNS = "# columns"


def read_markups_points(data: bytes, where: str) -> RawPoints:
    """The points of a Slicer markups file, fiducials or the ends of a line, by label: the case names the target's."""
    tree = parse_json(data, where=where, allowed=_MARKUPS_ALLOWED)
    markups = tree.get("markups") if isinstance(tree, dict) else None
    if not isinstance(markups, list) or len(markups) != 1 or not isinstance(markups[0], dict):
        refuse("not exactly one entry in 'markups'", where, _MARKUPS_ALLOWED, "wrong_count")
    markup = markups[0]
    kind, listed = markup.get("type", "Fiducial"), markup.get("controlPoints")
    if kind not in ("Fiducial", "Line"):
        refuse(f"markup of type {str(kind)[:40]!r}", where, _MARKUPS_ALLOWED, "unknown_type")
    if not isinstance(listed, list) or not listed:
        refuse("no control point", where, _MARKUPS_ALLOWED, "empty")
    if kind == "Line" and len(listed) != 2:
        refuse(f"a line of {len(listed)} control points", where, "both ends of a line: 2 control points", "wrong_count")
    placed = [(f"{where}, control point {number}", point) for number, point in enumerate(listed, start=1)]
    names, points = [], []
    for place, point in placed:
        label = point.get("label") if isinstance(point, dict) else None
        if not isinstance(label, str) or not label.strip():
            refuse(f"label {str(label)[:40]!r}", place, "a label that is not empty", "bad_name")
        names.append(label.strip())
    for place, point in placed:
        status, position = point.get("positionStatus", "defined"), point.get("position")
        if status != "defined":
            refuse(f"positionStatus is {str(status)[:40]!r}", place, '"defined"', "point_undefined")
        numbers = [one for one in position if type(one) in (int, float)] if isinstance(position, list) else []
        if len(numbers) != 3 or len(position) != 3:
            refuse(f"position {str(position)[:60]!r}", place, "three numbers", "not_a_number")
        x, y, z = (parse_coordinate(str(value), place) for value in numbers)
        points.append((x, y, z))
    stated = markup.get("coordinateUnits")
    stated = "mm" if stated is None else stated  # the schema's default
    text = stated[0] if isinstance(stated, list) and stated else stated
    if not isinstance(text, str):
        what = f"coordinateUnits {str(stated)[:40]!r}"
        refuse(what, where, 'such as "mm" or ["mm", "UCUM", "millimeter"]', "unknown_unit")
    unit = parse_unit(text, where=where)
    return RawPoints(names, points, unit, _space(markup.get("coordinateSystem"), where))


def read_fcsv_points(data: bytes, where: str) -> RawPoints:
    """The points of an older Slicer fiducial list, which is in mm by its definition."""
    lines = decode_text(data, where).splitlines()
    system, header = _fcsv_value(lines, _FCSV_SYSTEM), _fcsv_value(lines, _FCSV_COLUMNS)
    columns = [] if header is None else [name.strip() for name in header.split(",")]
    if any(columns.count(name) != 1 for name in ("x", "y", "z", "label")):
        refuse(f"columns {columns}", where, _FCSV_ALLOWED, "wrong_columns")
    names, points = [], []
    for number, fields in csv_lines(data, where, _FCSV_ALLOWED):
        place = f"{where}, line {number}"
        if len(fields) - len(columns) not in (0, 2):
            refuse(f"{len(fields)} fields instead of {len(columns)}", place, _FCSV_ALLOWED, "ragged_row")
        if (status := (*fields, _FCSV_DEFINED)[len(columns)]) != _FCSV_DEFINED:
            refuse(f"position status {status[:40]!r}", place, f"{_FCSV_DEFINED} (defined)", "point_undefined")
        names.append(fields[columns.index("label")].strip())
        x, y, z = (parse_coordinate(fields[columns.index(axis)], place) for axis in "xyz")
        points.append((x, y, z))
    return RawPoints(names, points, Unit.MM, _space(system, where))


def _space(value: object, where: str) -> Space:
    key = str(value).strip() if isinstance(value, (str, int)) and not isinstance(value, bool) else ""
    if key not in _SPACES:
        refuse(f"coordinate system {str(value)[:40]!r}", where, "LPS or RAS (in older files 1 or 0)", "unknown_space")
    return _SPACES[key]


def _fcsv_value(lines: list[str], key: str) -> str | None:
    found = [line.partition("=")[2].strip() for line in lines if line.lower().startswith(key)]
    return found[0] if len(found) == 1 else None


_READERS: Mapping[str, Callable[[bytes, str], RawPoints]] = MappingProxyType(
    {".csv": read_csv_points, ".mrk.json": read_markups_points, ".fcsv": read_fcsv_points}
)
AngleUnit = Literal["rad", "deg"]
JOINTS_DEG = tuple(f"q{number}_deg" for number in range(1, 7))
JOINTS_RAD = tuple(f"q{number}_rad" for number in range(1, 7))
RTDE_JOINTS = tuple(f"actual_q_{number}" for number in range(6))
RTDE_TOOL = tuple(f"actual_TCP_pose_{number}" for number in range(3))
"""Where the controller has its tool, m, base frame."""
TORQUES = tuple(f"tau{number}_nm" for number in range(1, 7)), tuple(f"target_moment_{number}" for number in range(6))
"""Columns of joint torques, N m: ours, and RTDE's."""
TIMES = ("time_s", "timestamp")
MOST_RAD = np.radians([363.0, 363.0, 363.0, 363.0, 363.0, 720.0])
"""A UR's joint reads a whole turn to either side, and 3 degrees that its limits leave; wrist 3 may turn on."""
WHOLE_TURN = 2.0 * np.pi + 0.05
"""Six angles that all lie within it are none in degrees: an arm that lies stretched out, or radians."""
_ALLOWED_JOINTS = "six angles, q1_deg to q6_deg, q1_rad to q6_rad or RTDE's actual_q_0 to actual_q_5, one row per pose"


class JointRecording(NamedTuple):
    """Rows of a recording of joints."""

    names: tuple[str, ...]  # names of the rows, or their numbers
    q: Floats  # shape (n, 6), rad
    time_s: Floats | None  # shape (n,); None where the file has no times
    tool_base: Floats | None  # where the controller had its tool, shape (n, 3), mm; None where the file does not say it
    torque_nm: Floats | None = None  # shape (n, 6); None where the file has no torques


def joint_readings(values: ArrayLike, unit: AngleUnit, *, where: str | Path, names: Sequence[str] = ()) -> Floats:
    """Joint angles that an arm can have, shape (n, 6), rad; of ``values`` (n, 6), in the unit.

    Raises InputError: not six finite angles each, beyond what a joint can read, or plainly in the other unit.
    """
    given = np.asarray(values)
    if given.dtype.kind not in "iuf" or given.ndim != 2 or given.shape[1] != 6 or not np.isfinite(given).all():
        what = f"joint angles {str(np.array(values, dtype=object).tolist())[:80]}"
        refuse(what, where, "six finite angles", "joints")
    q = np.array(np.radians(given) if unit == "deg" else given, dtype=np.float64)
    beyond = np.abs(q) > MOST_RAD
    if beyond.any():
        row, joint = (int(i) for i in np.argwhere(beyond)[0])
        name = names[row] if row < len(names) else f"row {row + 1}"
        degrees = np.abs(given).max() > 2 * WHOLE_TURN and (np.abs(given) <= np.degrees(MOST_RAD)).all()
        guess = ": degrees?" if unit == "rad" and degrees else ""
        what = f"joint {joint + 1} of {name} at {given[row, joint]:g} {unit}, beyond its range{guess}"
        refuse(what, where, "363 degrees (6.34 rad) either way; wrist 3: two turns", "joints_beyond")
    if unit == "deg" and plainly_radians(given):
        what = f"every joint is within {np.abs(given).max():.3g} degrees of zero: in radians?"
        refuse(what, where, "degrees, as in the names of the columns", "joints_unit")
    return q


def plainly_radians(angles_deg: ArrayLike) -> bool:
    """Whether angles of an arm's joints, stated as degrees, are radians: none beyond 2 pi, and not all zero."""
    return 0.0 < float(np.abs(np.asarray(angles_deg, dtype=np.float64)).max(initial=0.0)) <= WHOLE_TURN


def parse_joint_recording(data: bytes, path: Path, *, timed: bool) -> JointRecording:
    """The joints of a CSV: a header, then a row a pose; other columns do not count.

    Separated by commas, or by blanks as RTDE's own client writes it. ``timed``: whether it must hold times, which rise
    within each phase where there is a column ``phase``, as in a plan that was exported.
    Raises InputError: a column is missing, something is no number, or the angles or times are of no arm.
    """
    lines = list(csv_lines(data, str(path), _ALLOWED_JOINTS, blanks=True))
    header = [cell.strip().strip('"') for cell in lines[0].fields] if lines else []
    kinds: list[tuple[tuple[str, ...], AngleUnit]] = [(JOINTS_RAD, "rad"), (JOINTS_DEG, "deg"), (RTDE_JOINTS, "rad")]
    joints, unit = max(kinds, key=lambda kind: sum(name in header for name in kind[0]))
    missing = [name for name in joints if name not in header]
    if missing:
        what = "no joints" if len(missing) == len(joints) else f"lacks {', '.join(missing)}"
        refuse(what, path, _ALLOWED_JOINTS, "missing_column")
    time = next((name for name in TIMES if name in header), None)
    if timed and time is None:
        refuse(f"lacks {' or '.join(TIMES)}", path, _ALLOWED_JOINTS, "missing_column")
    rows = lines[1:]
    if not rows:
        refuse("has no row", path, _ALLOWED_JOINTS, "empty")
    tool = RTDE_TOOL if set(RTDE_TOOL) <= set(header) else ()
    torques = next((names for names in TORQUES if set(names) <= set(header)), ())
    wanted = [*joints, *([time] if time else []), *torques, *tool]
    table = np.array([row_numbers(fields, header, wanted, f"{path}, line {line}") for line, fields in rows])
    names, phases = (
        tuple(fields[header.index(column)].strip() for _, fields in rows) if column in header else ()
        for column in ("name", "phase")
    )
    q = joint_readings(table[:, :6], unit, where=path, names=names)
    times = table[:, 6] if time else None
    if times is not None:
        begins = np.array(phases[1:]) != np.array(phases[:-1]) if phases else False
        back = np.flatnonzero((np.diff(times) < 0.0) & ~np.asarray(begins))
        if len(back):
            row = int(back[0])
            what = f"time goes backwards, from {times[row]:g} to {times[row + 1]:g} s"
            refuse(what, f"{path}, line {rows[row + 1].line}", "rows in order of time", "times_not_rising")
    names = names or tuple(str(i) for i in range(1, len(lines)))
    torque_nm = table[:, 6 + bool(time) :][:, :6] if torques else None
    return JointRecording(names, q, times, 1000.0 * table[:, -3:] if tool else None, torque_nm)


def named_points(points: NamedPoints | Mapping[str, ArrayLike], where: str) -> NamedPoints:
    """Named points, from whichever form. Raises InputError: a point that is not three finite numbers."""
    if isinstance(points, NamedPoints):
        return points
    if not all(isinstance(name, str) for name in points):
        refuse("a name is no text", where, "name to three finite numbers, mm", "wrong_type")
    return NamedPoints(tuple(points), guard_points(list(points.values()), tuple(points), where=where), None)


def typed_point(point: ArrayLike, where: str) -> str:
    """A point, shape (3,), mm, as it is typed on a command line. Raises InputError: it is not three finite numbers."""
    return ",".join(map(repr, named_points({"point": point}, where).points[0].tolist()))
