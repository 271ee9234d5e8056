"""Named points of other programs: CSV, Slicer markups (.mrk.json) and the older Slicer lists (.fcsv), in mm.

A CSV states its unit in the header (``name,x_mm,y_mm,z_mm``) and leaves the space to the case; Slicer's files state
both. Whatever states a patient space arrives in LPS.
"""

from __future__ import annotations

import csv
import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.brief import brief
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.input_file import read_input
from puncture_twin.planning.formats.guard import guard_points
from puncture_twin.planning.formats.joint_readings import JOINTS_DEG, joint_readings
from puncture_twin.planning.formats.points.points_csv import read_csv_points
from puncture_twin.planning.formats.points.points_slicer import read_fcsv_points, read_markups_points
from puncture_twin.planning.formats.points.raw_points import RawPoints
from puncture_twin.planning.geometry.spaces import Space, to_lps
from puncture_twin.planning.geometry.units import Unit

MAX_FILE_BYTES = 10_000_000
"""A hundred thousand points; a larger file is no list of markers."""

_READERS: Mapping[str, Callable[[bytes, str], RawPoints]] = MappingProxyType(
    {".csv": read_csv_points, ".mrk.json": read_markups_points, ".fcsv": read_fcsv_points}
)


MOST_NAMED = 8
"""Points that a line about a list names."""


@dataclass(frozen=True, eq=False)
class NamedPoints:
    """Points with names, as guarded: finite, at least one, every name once.

    Attributes:
        names: Shape (n,), in the order of the file.
        points: Shape (n, 3), mm, read-only, in ``space``.
        space: LPS for patient data, LOCAL for a frame of its own, None where nobody said (such as a robot's base).
        kinds: Shape (n,), what each point is, where the file says so ("marker", "lesion").
        joints: Shape (n, 6), rad, read-only: how the robot stood at the touch of each, where the file says so.
    """

    names: tuple[str, ...]
    points: NDArray[np.float64]
    space: Space | None
    kinds: tuple[str, ...] | None = None
    joints: NDArray[np.float64] | None = None

    @brief
    def __repr__(self) -> str:
        named = ", ".join(self.names[:MOST_NAMED]) + (", ..." if len(self.names) > MOST_NAMED else "")
        return f"{len(self.names)} points, {self.space or 'no space stated'}: {named}"

    def __post_init__(self) -> None:
        for name in ("points", "joints"):
            if getattr(self, name) is not None:
                array = np.array(getattr(self, name), dtype=np.float64)
                array.setflags(write=False)
                object.__setattr__(self, name, array)


def read_points(
    path: Path,
    *,
    default_space: Space | None = None,
    default_unit: Unit | None = None,
) -> NamedPoints:
    """The points of one file, in mm; in LPS where the file or the caller names a patient space.

    Args:
        path: A .csv, .mrk.json or .fcsv file.
        default_space: The space of a file that states none: the case's, or None for a robot's base.
        default_unit: The unit of a file that states none; None refuses such a file.

    Raises:
        InputError: If it cannot be read, contradicts the caller, or its points fail the guard.
    """
    _reader(path, str(path))  # an unknown ending is refused before anything is read
    data = read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path))
    return parse_points(data, path, default_space=default_space, default_unit=default_unit)


def parse_points(
    data: bytes,
    path: Path,
    *,
    default_space: Space | None = None,
    default_unit: Unit | None = None,
) -> NamedPoints:
    """The same of a file that has been read; it is not opened again.

    Args:
        data: The whole file.
        path: Its name, whose ending says the format.
        default_space: As in `read_points`.
        default_unit: As in `read_points`.

    Raises:
        InputError: As `read_points`, but for reading.
    """
    name = str(path)
    raw = _reader(path, name)(data, name)
    unit = raw.unit or default_unit
    if unit is None:
        raise InputError("no unit of length", where=name, allowed="x_mm,y_mm,z_mm in the header")
    if raw.space is not None and default_space is Space.LOCAL:
        message = f"points in {raw.space}, but the case has a local frame"
        raise InputError(message, where=name, allowed="points in the case's own space, as CSV")
    space = raw.space or default_space
    points = np.array(raw.points, dtype=np.float64).reshape(-1, 3)
    with np.errstate(over="ignore"):  # beyond the range of floats is infinite, which the guard refuses
        points = points * unit.mm if space is None else to_lps(points, space) * unit.mm
    guarded = guard_points(points, raw.names, where=name)
    joints = None
    if raw.joints_deg is not None:
        joints = joint_readings(raw.joints_deg, "deg", where=name, names=raw.names)
    return NamedPoints(tuple(raw.names), guarded, Space.LPS if space is Space.RAS else space, raw.kinds, joints)


def _reader(path: Path, where: str) -> Callable[[bytes, str], RawPoints]:
    reader = next((read for suffix, read in _READERS.items() if path.name.lower().endswith(suffix)), None)
    if reader is None:
        raise InputError(f"unknown point file {path.name!r}", where=where, allowed=", ".join(_READERS))
    return reader


def write_points(path: Path, points: NamedPoints) -> None:
    """A CSV with ``name,x_mm,y_mm,z_mm``, and joints, that reads back to the same numbers; whole, or not at all.

    The space is not written: a CSV speaks in the space of its case.

    Raises:
        InputError: If the place cannot be written to.
    """
    joints = points.joints is not None
    header = ["name", *(["kind"] if points.kinds else []), "x_mm", "y_mm", "z_mm"]
    header += JOINTS_DEG if joints else []
    labels = zip(points.names, points.kinds, strict=True) if points.kinds else ((name,) for name in points.names)
    numbers = points.points if points.joints is None else np.hstack([points.points, np.degrees(points.joints)])
    rows = [[*label, *map(repr, row)] for label, row in zip(labels, numbers.tolist(), strict=True)]
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".part")
    except OSError as error:
        raise InputError(f"cannot be written ({error})", where=path, allowed="a folder to write to") from error
    part = Path(name)
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([header, *rows])
        part.replace(path)
    except OSError as error:
        raise InputError(f"cannot be written ({error})", where=path, allowed="a file name of a folder") from error
    finally:
        part.unlink(missing_ok=True)
