"""The one gate for how an arm stood: joint angles and times that a file, a case or a controller states.

A recording, a list of touches, a case's home and a live controller's word come through here: angles that a joint can
have, in the unit that is stated, at times that do not run backwards. Whose arm: `planning/arm/stated_arm.py`.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.input_file import decode_text
from puncture_twin.planning.formats.points.raw_points import parse_coordinate

Unit = Literal["rad", "deg"]

JOINTS_DEG = tuple(f"q{number}_deg" for number in range(1, 7))
JOINTS_RAD = tuple(f"q{number}_rad" for number in range(1, 7))
RTDE_JOINTS = tuple(f"actual_q_{number}" for number in range(6))
RTDE_TOOL = tuple(f"actual_TCP_pose_{number}" for number in range(3))
"""Where the controller has its tool, m, base frame."""
TIMES = ("time_s", "timestamp")

MOST_RAD = np.radians([363.0, 363.0, 363.0, 363.0, 363.0, 720.0])
"""A UR's joint reads a whole turn to either side, and 3 degrees that its limits leave; wrist 3 may turn on."""

WHOLE_TURN = 2.0 * np.pi + 0.05
"""Six angles that all lie within it are none in degrees: an arm that lies stretched out, or radians."""
_ALLOWED = "six angles, q1_deg to q6_deg, q1_rad to q6_rad or RTDE's actual_q_0 to actual_q_5, one row a pose"


class JointRecording(NamedTuple):
    """Rows of a recording."""

    names: tuple[str, ...]
    """What their ``name`` says, or their numbers."""
    q: Floats
    """Shape (n, 6), rad."""
    time_s: Floats | None
    """Shape (n,); None where the file has no times."""
    tool_base: Floats | None
    """Where the controller had its tool, shape (n, 3), mm; None where the file does not say it."""


def joint_readings(values: ArrayLike, unit: Unit, *, where: str | Path, names: Sequence[str] = ()) -> Floats:
    """Joint angles that an arm can have, shape (n, 6), rad.

    Args:
        values: Shape (n, 6), in the unit.
        unit: That the file states.
        where: The file, for the error.
        names: Of the rows; none: their numbers.

    Raises:
        InputError: Not six finite angles each, beyond what a joint can read, or plainly in the other unit.
    """
    given = np.asarray(values)
    if given.dtype.kind not in "iuf" or given.ndim != 2 or given.shape[1] != 6 or not np.isfinite(given).all():
        what = f"joint angles {str(np.array(values, dtype=object).tolist())[:80]}"
        raise InputError(what, where=where, allowed="six finite angles", code="joints")
    q = np.array(np.radians(given) if unit == "deg" else given, dtype=np.float64)
    beyond = np.abs(q) > MOST_RAD
    if beyond.any():
        row, joint = (int(i) for i in np.argwhere(beyond)[0])
        name = names[row] if row < len(names) else f"row {row + 1}"
        likely = (
            unit == "rad" and np.abs(given).max() > 2 * WHOLE_TURN and (np.abs(given) <= np.degrees(MOST_RAD)).all()
        )
        guess = ": degrees?" if likely else ""
        what = f"joint {joint + 1} of {name} at {given[row, joint]:g} {unit}, beyond what it can read{guess}"
        limits = "363 degrees (6.34 rad) to either side, wrist 3 two turns"
        raise InputError(what, where=where, allowed=limits, code="joints_beyond")
    if unit == "deg" and plainly_radians(given):
        what = f"every joint within {np.abs(given).max():.3g} degrees of zero: radians?"
        raise InputError(what, where=where, allowed="degrees, as the names of the columns say", code="joints_unit")
    return q


def plainly_radians(angles_deg: ArrayLike) -> bool:
    """Whether angles of an arm's joints, stated as degrees, are radians: none beyond 2 pi, and not all zero."""
    most = float(np.abs(np.asarray(angles_deg, dtype=np.float64)).max(initial=0.0))
    return 0.0 < most <= WHOLE_TURN


def check_times(time_s: Floats, *, where: str | Path) -> None:
    """Refuse times (n,) that run backwards.

    Raises:
        InputError: Names the row.
    """
    back = np.flatnonzero(np.diff(time_s) < 0.0)
    if len(back):
        row = int(back[0])
        what = f"row {row + 2}: the time runs backwards, from {time_s[row]:g} to {time_s[row + 1]:g} s"
        raise InputError(what, where=where, allowed="rows in the order of their times", code="times_backwards")


def parse_joint_recording(data: bytes, path: Path, *, timed: bool) -> JointRecording:
    """The joints of a CSV: a header, then a row a pose; other columns and lines with # do not count.

    Separated by commas, or by spaces as RTDE's own client writes it.

    Args:
        data: The whole file.
        path: Its name, for errors.
        timed: Whether it must hold times.

    Raises:
        InputError: A column is missing, something is no number, or the angles or times are of no arm.
    """
    lines = [line for line in decode_text(data, str(path)).splitlines() if line.strip() and not line.startswith("#")]
    comma = bool(lines) and "," in lines[0]
    try:
        rows = list(csv.reader(lines, strict=True)) if comma else [line.split() for line in lines]
    except csv.Error as error:
        raise InputError(f"is no CSV ({error})", where=path, allowed=_ALLOWED) from error
    header = [cell.strip().strip('"') for cell in rows[0]] if rows else []
    joints, unit = _joint_columns(header, path)
    time = next((name for name in TIMES if name in header), None)
    if timed and time is None:
        raise InputError(f"lacks {' or '.join(TIMES)}", where=path, allowed=_ALLOWED, code="column_missing")
    if len(rows) < 2:
        raise InputError("holds no row", where=path, allowed=_ALLOWED)
    tool = RTDE_TOOL if set(RTDE_TOOL) <= set(header) else ()
    wanted = [*joints, *([time] if time else []), *tool]
    table = np.array([row_numbers(row, header, wanted, f"{path}: row {i}") for i, row in enumerate(rows[1:], start=1)])
    names = tuple(row[header.index("name")].strip() for row in rows[1:]) if "name" in header else ()
    q = joint_readings(table[:, :6], unit, where=path, names=names)
    times = table[:, 6] if time else None
    if times is not None:
        check_times(times, where=path)
    names = names or tuple(str(i) for i in range(1, len(rows)))
    return JointRecording(names, q, times, 1000.0 * table[:, -3:] if tool else None)


def _joint_columns(header: Sequence[str], path: Path) -> tuple[tuple[str, ...], Unit]:
    """The columns of the joints, and the unit of their angles."""
    kinds: tuple[tuple[tuple[str, ...], Unit], ...] = ((JOINTS_RAD, "rad"), (JOINTS_DEG, "deg"), (RTDE_JOINTS, "rad"))
    columns, unit = max(kinds, key=lambda kind: sum(name in header for name in kind[0]))
    missing = [name for name in columns if name not in header]
    if missing:
        what = "no joints" if len(missing) == len(columns) else f"lacks {', '.join(missing)}"
        raise InputError(what, where=path, allowed=_ALLOWED, code="column_missing")
    return columns, unit


def row_numbers(row: Sequence[str], header: Sequence[str], wanted: Sequence[str], where: str) -> list[float]:
    """The numbers of one row of a table in the columns that are wanted.

    Raises:
        InputError: More or fewer fields than the header has, or one that is no finite number.
    """
    if len(row) != len(header):
        raise InputError(f"{len(row)} fields", where=where, allowed=f"{len(header)} fields, as in the header")
    return [parse_coordinate(row[header.index(name)].strip(), f"{where}, {name}") for name in wanted]
