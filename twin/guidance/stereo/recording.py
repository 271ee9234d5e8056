"""A stereo session in a folder: tables and pictures, written while a session runs, and read as devices again.

``points.csv`` has a row for each point of the calibration, with the joints that were commanded and the measuring arm's
reading in C; ``markers.csv`` where an operator pointed, in C; ``stops.csv`` the joints at which the ball was looked at,
with the target. ``markers_image.csv`` and ``targets_image.csv`` are the readings in the CT, where they are not the
case's. A picture is ``<table>_<row>_<camera>_<n>.png``, all counted from 1, 8 bit grey, as large as the case says.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import is_plain_file, read_input
from puncture_twin.planning.formats.points import NamedPoints, joint_readings, read_points, write_points
from puncture_twin.planning.formats.pose_table import parse_table, table_text
from puncture_twin.planning.geometry.spaces import Unit
from puncture_twin.twin.devices import Arm, Cameras, GreyImage, MeasuringArm, Operator
from puncture_twin.twin.guidance.stereo.session import ImageReading
from puncture_twin.twin.pictures import parse_png, png_bytes

POINTS, MARKERS, STOPS = "points", "markers", "stops"
JOINTS, PLACE = tuple(f"q{i}_deg" for i in range(1, 7)), ("x_mm", "y_mm", "z_mm")
COLUMNS = {POINTS: ("name", *JOINTS, *PLACE), MARKERS: ("name", *PLACE), STOPS: ("target", *JOINTS)}
IMAGE_POINTS = ("markers_image.csv", "targets_image.csv")
MAX_BYTES, MAX_PICTURE_BYTES = 1_000_000, 50_000_000
WHOLE_PX = 1e6
"""Reach of a picture that shows all that its camera sees."""


class StereoDevices(Arm, Cameras, MeasuringArm, Operator, Protocol):
    """All devices of a session in one."""


class RecordedTable(NamedTuple):
    """One table of a recording."""

    names: tuple[str, ...]
    values: Floats
    """Shape (n, k): what follows the name."""


@dataclass
class Recorder:
    """Devices that are used through it, and all that they said.

    Attributes:
        folder: Empty; pictures are written at once, tables by `finish`.
        target: To which the arm is sent.
    """

    devices: StereoDevices
    folder: Path
    target: str = ""
    _rows: dict[str, list[list[str]]] = field(default_factory=lambda: {table: [] for table in COLUMNS})
    _taken: dict[tuple[str, int, int], int] = field(default_factory=dict)
    _table: str = POINTS
    _joints: tuple[str, ...] = ()

    def move_jp(self, q: Floats) -> None:
        """Move; what is looked at next is a stop, unless it is measured."""
        self.devices.move_jp(q)
        self._joints, self._table = tuple(map(repr, np.degrees(self.measured_jp()).tolist())), ""

    def measured_jp(self) -> Floats:
        """Where the arm rests: what is kept of a move."""
        return self.devices.measured_jp()

    def measured_cp(self) -> Floats:
        """The measuring arm's reading: a point of the calibration."""
        point = self.devices.measured_cp()
        self._begin(POINTS, f"P{len(self._rows[POINTS]) + 1}", *self._joints, *map(repr, point.tolist()))
        return point

    def pointed_cp(self, marker: str) -> Floats:
        """Where the operator points."""
        point = self.devices.pointed_cp(marker)
        self._begin(MARKERS, marker, *map(repr, point.tolist()))
        return point

    def measured_image(self, number: int, about_px: Floats, reach_px: float) -> GreyImage:
        """A whole picture, whatever part of it is queried; it is kept."""
        image = self.devices.measured_image(number, about_px, max(reach_px, WHOLE_PX))
        if not self._table:
            self._begin(STOPS, self.target, *self._joints)
        key = (self._table, len(self._rows[self._table]), number + 1)
        self._taken[key] = self._taken.get(key, 0) + 1
        picture_path(self.folder, *key, self._taken[key]).write_bytes(png_bytes(image.grey))
        return image

    def finish(self, names: tuple[tuple[str, ...], tuple[str, ...]], reading: ImageReading) -> None:
        """Write the tables, and markers and targets as they were read in the CT, by their names."""
        for table, rows in self._rows.items():
            (self.folder / f"{table}.csv").write_text(table_text(COLUMNS[table], rows), encoding="utf-8")
        for file, some, points in zip(IMAGE_POINTS, names, reading, strict=True):
            write_points(self.folder / file, NamedPoints(some, points, None))

    def _begin(self, table: str, *row: str) -> None:
        self._table = table
        self._rows[table].append(list(row))


def picture_path(folder: Path, table: str, row: int, camera: int, number: int) -> Path:
    """Where a picture lies; row, camera and number count from 1."""
    return folder / f"{table}_{row:03d}_{camera}_{number}.png"


@dataclass
class Replay:
    """A recording as devices: it answers what was recorded, in the order in which it was.

    Attributes:
        size_px: Width and height of every picture.
    """

    folder: Path
    tables: dict[str, RecordedTable]
    size_px: tuple[int, int]
    _at: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COLUMNS, 0))
    _table: str = POINTS
    _seen: dict[tuple[str, int, int], int] = field(default_factory=dict)

    @property
    def q_points(self) -> Floats:
        """Commanded joints of the calibration, shape (k, 6), rad."""
        return np.asarray(np.radians(self.tables[POINTS].values[:, :6]))

    @property
    def stops(self) -> list[tuple[str, Floats]]:
        """Target and commanded joints (6,), rad, of each stop."""
        return list(zip(self.tables[STOPS].names, np.radians(self.tables[STOPS].values), strict=True))

    def move_jp(self, q: Floats) -> None:
        """Go on to the next row of points or, after the last, of stops."""
        self._table = POINTS if self._at[POINTS] < len(self.tables[POINTS].names) else STOPS
        self._at[self._table] += 1
        assert np.allclose(self.measured_jp(), q)  # whoever replays sends the recorded joints

    def measured_jp(self) -> Floats:
        """The current row's joints, shape (6,), rad."""
        return np.asarray(np.radians(self.tables[self._table].values[self._at[self._table] - 1, :6]))

    def measured_cp(self) -> Floats:
        """The measuring arm's reading at the current point, shape (3,), mm, C."""
        return np.asarray(self.tables[POINTS].values[self._at[POINTS] - 1, 6:])

    def pointed_cp(self, marker: str) -> Floats:
        """Where the operator pointed, shape (3,), mm, C.

        Raises:
            InputError: A marker that was not recorded.
        """
        table, self._table = self.tables[MARKERS], MARKERS
        if marker not in table.names:
            refuse(f"marker {marker} is not recorded", self.folder / "markers.csv", ", ".join(table.names), "no_marker")
        self._at[MARKERS] = table.names.index(marker) + 1
        return np.asarray(table.values[self._at[MARKERS] - 1])

    def measured_image(self, number: int, about_px: Floats, reach_px: float) -> GreyImage:
        """The next picture of a camera at the current row; after the last one that again.

        Raises:
            InputError: There is none, or it is no 8-bit grey picture.
        """
        del about_px, reach_px  # what was recorded is what there is
        key = (self._table, self._at[self._table], number + 1)
        count = self._seen.get(key, 0) + 1
        path = picture_path(self.folder, *key, count)
        if count > 1 and not is_plain_file(path):
            count -= 1
            path = picture_path(self.folder, *key, count)
        self._seen[key] = count
        grey = parse_png(read_input(path, max_bytes=MAX_PICTURE_BYTES, where=str(path)), path)
        if grey.shape != self.size_px[::-1]:
            width, height = self.size_px
            what = f"a picture of {grey.shape[1]} x {grey.shape[0]} pixels"
            refuse(what, path, f"{width} x {height}, as [cameras] size_px", "wrong_size")
        return GreyImage(grey)

    def reading(self, markers: NamedPoints, targets: NamedPoints) -> ImageReading:
        """Markers and targets as they were read in the CT: the recording's, else the case's.

        Raises:
            InputError: Other names than the case's.
        """
        found = []
        for file, own in zip(IMAGE_POINTS, (markers, targets), strict=True):
            path = self.folder / file
            points = read_points(path, default_unit=Unit.MM) if is_plain_file(path) else own
            if set(points.names) != set(own.names):
                refuse(f"names {', '.join(points.names)}", path, f"the case's: {', '.join(own.names)}", "names_differ")
            found.append(points.points[[points.names.index(name) for name in own.names]])
        return ImageReading(*found)


def read_recording(folder: Path, size_px: tuple[int, int]) -> Replay:
    """The tables of a recording; its pictures are read when they are looked at.

    Args:
        size_px: Width and height of every picture.

    Raises:
        InputError: A table is absent, has other columns, or a field that is no number.
    """
    tables = {}
    for table, header in COLUMNS.items():
        path = folder / f"{table}.csv"
        content = read_input(path, max_bytes=MAX_BYTES, where=str(path))
        groups = {"all": header[1:]}
        names, numbers, _ = parse_table(content, path, groups, bool, ("all",), first=header[0])
        if table == MARKERS and len(set(names)) < len(names):
            refuse(f"a marker appears twice: {', '.join(names)}", path, "each name once", "duplicate_name")
        tables[table] = RecordedTable(names, numbers["all"])
    for table in (POINTS, STOPS):
        joint_readings(tables[table].values[:, :6], "deg", where=folder / f"{table}.csv", names=tables[table].names)
    return Replay(folder, tables, size_px)
