"""What both arms and the image said, pose by pose: the input of the self-calibration, in memory and as CSV.

Frames: ``base1`` and ``end1`` of the arm that holds the probe, ``image`` (mm, the slice is z = 0), ``base2`` and
``end2`` of the arm that holds the needle.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.files import atomic, is_folder
from puncture_twin.planning.base.input_file import read_input
from puncture_twin.planning.formats.guard import MAX_COORDINATE_MM, ROTATION_TOLERANCE
from puncture_twin.planning.formats.points.raw_points import parse_coordinate
from puncture_twin.planning.formats.raw_mesh import decode_text
from puncture_twin.planning.geometry.rigid import pose

FILE_NAME = "recording.csv"
"""What a folder is searched for."""

MAX_BYTES = 50_000_000
"""More than 50,000 poses: no calibration needs so many, and a larger file is likely something else."""

OPTIONAL = ("v", "shaft_mm", "q_probe", "q_needle", "turn_probe", "turn_needle")
"""What a recording may hold beside both flanges and the tip: arrays with one row per pose."""

SHAFT_POWER = 1.5
"""A line's angle errs with the power -3/2 of its length: the variance of a least squares slope through n evenly spaced
points is 12 sigma^2 / (n length^2), n as the length. Detected in pictures: .17 deg at 10 mm, .11 at 15, .03 at 32."""

LEAST_SHAFT_MM = 1.0
"""Nothing shorter shows a direction."""

LEAST_IN_PLANE = 0.5
"""Least share of a needle direction that must lie in the image: a needle that leans more does not show as a line."""


class Noise(NamedTuple):
    """Standard deviations per axis of what a recording holds, normal errors."""

    robot_mm: float
    """Position of each flange."""
    robot_rad: float
    """Orientation of each flange, per axis of a small turn."""
    image_mm: float
    """The tip in the image, per axis of the image."""
    direction_rad: float
    """The needle's direction in the image."""
    off_plane_mm: float = 0.0
    """How far the tip lies off the slice and still shows."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Poses of both arms with the needle seen in the image. Checked when made; the arrays are read-only.

    Attributes:
        A: T_base1_end1, shape (n, 4, 4), mm: flange of the probe's arm.
        B: T_base2_end2, shape (n, 4, 4), mm: flange of the needle's arm.
        P: The tip in the image, shape (n, 2), mm (pixels where ``pixels`` is set).
        v: Direction of the needle toward its tip, in the image, made unit. Shape (n, 2) where the image alone says it,
            (n, 3) where the part across the image is measured too; None where it was not measured.
        names: One per pose; numbers where nothing is given.
        pixels: P counts pixels, and mm per pixel is to be found.
        q_probe: Joints of the probe's arm, shape (n, 6), rad, as its controller prints them; None where they were not
            recorded. Without them errors of the arms cannot be identified from noise.
        q_needle: Joints of the needle's arm, shape (n, 6), rad; given if and only if the probe's are.
        turn_probe: Which way each joint of the probe's arm last turned before it stopped, shape (n, 6): 1, -1, or 0
            where nobody knows. None where it was not recorded: the play's sign is then unknown.
        turn_needle: The same of the needle's arm; both only beside joints.
        shaft_mm: How much of the shaft shows, shape (n,): the more, the better its direction is known. Only beside
            directions; None where it was not measured: all directions then count the same.

    Raises:
        InputError: Shapes that do not match, values that are not finite, matrices that are not rigid motions.
    """

    A: Floats
    B: Floats
    P: Floats
    v: Floats | None = None
    names: tuple[str, ...] = ()
    pixels: bool = False
    q_probe: Floats | None = None
    q_needle: Floats | None = None
    turn_probe: Floats | None = None
    turn_needle: Floats | None = None
    shaft_mm: Floats | None = None

    def __post_init__(self) -> None:
        n = len(np.atleast_1d(self.A))
        names = tuple(self.names) or tuple(str(i + 1) for i in range(n))
        if n == 0 or len(names) != n or len(set(names)) != n:
            raise InputError(
                f"{n} poses and {len(set(names))} different names", where="recording", allowed="one name per pose"
            )
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "A", _rigid(self.A, "A", names))
        object.__setattr__(self, "B", _rigid(self.B, "B", names))
        object.__setattr__(self, "P", _finite(self.P, "P", names, widths=(2,)))
        if self.v is not None:
            object.__setattr__(self, "v", _directions(self.v, names))
        if self.shaft_mm is not None:
            object.__setattr__(self, "shaft_mm", _lengths(self.shaft_mm, self.v, names))
        if (self.q_probe is None) != (self.q_needle is None):
            raise InputError("joints of one arm only", where="recording", allowed="those of both, or none")
        for key in ("q_probe", "q_needle"):
            if getattr(self, key) is not None:
                object.__setattr__(self, key, _finite(getattr(self, key), key, names, widths=(6,)))
        if (self.turn_probe is None) != (self.turn_needle is None) or (self.turn_probe is not None and not self.joints):
            raise InputError("turns without joints, or of one arm only", where="recording", allowed="both, with joints")
        for key in ("turn_probe", "turn_needle"):
            if getattr(self, key) is not None:
                object.__setattr__(self, key, _signs(getattr(self, key), key, names))

    @property
    def joints(self) -> bool:
        """Whether the joints of both arms were recorded."""
        return self.q_probe is not None

    @property
    def direction_spread(self) -> Floats:
        """Each direction's standard deviation over all directions' rms, shape (n,)."""
        if self.shaft_mm is None:
            return np.ones(len(self))
        spread = self.shaft_mm**-SHAFT_POWER
        return np.asarray(spread / np.sqrt(np.mean(spread**2)))

    def __len__(self) -> int:
        return len(self.names)

    def subset(self, rows: NDArray[np.int_] | NDArray[np.bool_] | slice) -> Recording:
        """The same recording with these poses only."""
        names = tuple(np.array(self.names)[rows].tolist())
        parts: dict[str, Any] = {
            key: None if getattr(self, key) is None else getattr(self, key)[rows] for key in OPTIONAL
        }
        return Recording(self.A[rows], self.B[rows], self.P[rows], names=names, pixels=self.pixels, **parts)

    def joined(self, other: Recording) -> Recording:
        """Both, one after the other, numbered anew.

        Raises:
            InputError: One has directions or pixels and the other has not.
        """
        widths = [None if r.v is None else r.v.shape[1] for r in (self, other)]
        if widths[0] != widths[1] or self.pixels != other.pixels:
            raise InputError("two recordings that hold different things", where="recording", allowed="the same columns")
        A, B, P = (np.concatenate([getattr(r, key) for r in (self, other)]) for key in "ABP")
        parts: dict[str, Any] = {key: _both(getattr(self, key), getattr(other, key)) for key in OPTIONAL}
        return Recording(A, B, P, pixels=self.pixels, **parts)


def recording_file(path: Path) -> Path:
    """The CSV itself, also of a folder that holds ``recording.csv``."""
    return path / FILE_NAME if is_folder(path) else path


def read_recording(path: Path) -> Recording:
    """Read a recording from its CSV, or from ``recording.csv`` in a folder.

    Columns: ``name``; ``A_r11 .. A_r33, A_x_mm, A_y_mm, A_z_mm``; the same for B; ``P_u_mm, P_v_mm`` (or ``_px``); and,
    where directions were measured, ``v_x, v_y`` or ``v_x, v_y, v_z``, and behind them, where it was measured too, how
    much of the shaft shows, ``shaft_mm``; and, where the joints were recorded,
    ``A_q1_deg .. A_q6_deg, B_q1_deg .. B_q6_deg``; and, behind these, which way each joint last turned (1, -1; 0 where
    nobody knows), ``A_turn1 .. B_turn6``. Lines that start with # are passed over.

    Raises:
        InputError: Another header, a field that is no finite number, or a matrix that is no rigid motion.
    """
    file = recording_file(path)
    return parse_recording(read_input(file, max_bytes=MAX_BYTES, where=str(file)), file)


def parse_recording(content: bytes, file: Path) -> Recording:
    """The same of a file that has been read; it is not opened again.

    Raises:
        InputError: As `read_recording`, but for reading.
    """
    text = decode_text(content, str(file))
    try:
        rows = [row for row in csv.reader(io.StringIO(text), strict=True) if row and not row[0].startswith("#")]
    except csv.Error as error:
        raise InputError(f"is no CSV ({error})", where=file, allowed="one line per pose, fields of numbers") from error
    header = tuple(cell.strip() for cell in rows[0]) if rows else ()
    choices = product((False, True), ((0, 0), (2, 0), (3, 0), (2, 1), (3, 1)), (0, 12, 24))
    kinds = {_columns(*choice): choice for choice in choices}
    if header not in kinds:
        raise InputError(
            f"columns {', '.join(header)[:200]}",
            where=f"{file}, header",
            allowed=", ".join(_columns(False, (3, 1), 24)),
        )
    pixels, (width, shaft), behind = kinds[header]
    values = np.array([_numbers(row, header, f"{file}, row {i}") for i, row in enumerate(rows[1:], start=2)])
    if values.size == 0:
        raise InputError("no pose", where=file, allowed="one row per pose")
    names = tuple(row[0].strip() for row in rows[1:])
    try:
        first = 26 + width + shaft
        v, shaft_mm = values[:, 26 : 26 + width] if width else None, values[:, first - 1] if shaft else None
        q_probe, q_needle = np.radians(np.split(values[:, first : first + 12], 2, axis=1)) if behind else (None, None)
        turn_probe, turn_needle = np.split(values[:, first + 12 :], 2, axis=1) if behind == 24 else (None, None)
        A, B = _matrices(values[:, :12]), _matrices(values[:, 12:24])
        joints = (q_probe, q_needle, turn_probe, turn_needle)
        return Recording(A, B, values[:, 24:26], v, names, pixels, *joints, shaft_mm)
    except InputError as error:
        raise InputError(error.what, where=f"{file}: {error.where}", allowed=error.allowed) from error


def write_recording(recording: Recording, path: Path) -> None:
    """Write a recording as CSV, every number in full, whole or not at all.

    Raises:
        InputError: The file cannot be written.
    """
    seen = [part for part in (recording.v, recording.shaft_mm) if part is not None]
    width = 0 if recording.v is None else recording.v.shape[1]
    joints = [np.degrees(q) for q in (recording.q_probe, recording.q_needle) if q is not None]
    turns = [turn for turn in (recording.turn_probe, recording.turn_needle) if turn is not None]
    parts = [_row_major(recording.A), _row_major(recording.B), recording.P]
    values = np.column_stack([*parts, *seen, *joints, *turns])
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(
            _columns(recording.pixels, (width, int(recording.shaft_mm is not None)), 6 * len(joints + turns))
        )
        writer.writerows([name, *map(repr, row)] for name, row in zip(recording.names, values.tolist(), strict=True))


def _columns(pixels: bool, direction: tuple[int, int], behind: int) -> tuple[str, ...]:
    """The header: columns of the direction and of its shaft's length, and of the joints and turns behind them."""
    unit = "px" if pixels else "mm"
    poses = [
        [f"{arm}_r{i}{j}" for i in "123" for j in "123"] + [f"{arm}_{axis}_mm" for axis in "xyz"] for arm in ("A", "B")
    ]
    joints = [f"{arm}_q{i}_deg" for arm in "AB" for i in "123456"]
    turns = [f"{arm}_turn{i}" for arm in "AB" for i in "123456"]
    width, shaft = direction
    seen = (f"P_u_{unit}", f"P_v_{unit}", *("v_x", "v_y", "v_z")[:width], *("shaft_mm",)[:shaft])
    return ("name", *poses[0], *poses[1], *seen, *(joints + turns)[:behind])


def _both(first: Floats | None, second: Floats | None) -> Floats | None:
    """One after the other, where both are there."""
    return None if first is None or second is None else np.concatenate([first, second])


def _numbers(row: list[str], header: tuple[str, ...], where: str) -> list[float]:
    if len(row) != len(header):
        raise InputError(f"{len(row)} fields", where=where, allowed=f"{len(header)} fields, as in the header")
    return [parse_coordinate(cell, f"{where}, {name}") for name, cell in zip(header[1:], row[1:], strict=True)]


def _matrices(values: Floats) -> Floats:
    return pose(values[:, :9].reshape(-1, 3, 3), values[:, 9:])


def _row_major(T: Floats) -> Floats:
    return np.column_stack([T[:, :3, :3].reshape(-1, 9), T[:, :3, 3]])


def _finite(values: Floats, what: str, names: tuple[str, ...], *, widths: tuple[int, ...]) -> Floats:
    array = np.array(values, dtype=np.float64)
    if array.ndim != 2 or len(array) != len(names) or array.shape[1] not in widths:
        wanted = " or ".join(f"({len(names)}, {width})" for width in widths)
        raise InputError(f"{what} has shape {array.shape}", where="recording", allowed=wanted)
    bad = np.asarray(~(np.isfinite(array) & (np.abs(array) <= MAX_COORDINATE_MM)).all(axis=1))
    _refuse_first(bad, names, what, "is not finite or out of range", f"numbers within {MAX_COORDINATE_MM:g}")
    array.setflags(write=False)
    return array


def _lengths(values: Floats, v: Floats | None, names: tuple[str, ...]) -> Floats:
    if v is None:
        raise InputError("shaft_mm without directions", where="recording", allowed="beside v, or not at all")
    array = _finite(np.reshape(values, (-1, 1)), "shaft_mm", names, widths=(1,))[:, 0]
    _refuse_first(array < LEAST_SHAFT_MM, names, "shaft_mm", "is too little", f"at least {LEAST_SHAFT_MM:g} mm")
    return array


def _signs(values: Floats, what: str, names: tuple[str, ...]) -> Floats:
    array = _finite(values, what, names, widths=(6,))
    bad = np.asarray(~np.isin(array, (-1.0, 0.0, 1.0)).all(axis=1))
    _refuse_first(bad, names, what, "is no way to turn", "1, -1, or 0 where nobody knows")
    return array


def _rigid(T: Floats, what: str, names: tuple[str, ...]) -> Floats:
    array = np.array(T, dtype=np.float64)
    if array.shape != (len(names), 4, 4):
        raise InputError(f"{what} has shape {array.shape}", where="recording", allowed=f"({len(names)}, 4, 4)")
    _finite(array.reshape(len(names), 16), what, names, widths=(16,))
    R = array[:, :3, :3]
    error = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2))
    bad = (error > ROTATION_TOLERANCE) | (np.linalg.det(R) < 0) | (np.abs(array[:, 3] - [0, 0, 0, 1]).max(axis=1) > 0)
    allowed = f"a rotation (R^T R = 1 to {ROTATION_TOLERANCE:g}, determinant +1) and a translation, last row 0 0 0 1"
    _refuse_first(bad, names, what, "is not a rigid motion", allowed)
    array.setflags(write=False)
    return array


def _directions(v: Floats, names: tuple[str, ...]) -> Floats:
    array = np.array(_finite(v, "v", names, widths=(2, 3)))
    lengths = np.linalg.norm(array, axis=1)
    flat = np.linalg.norm(array[:, :2], axis=1) < LEAST_IN_PLANE * lengths
    _refuse_first(~np.any(array != 0, axis=1), names, "v", "has no length", "a direction")
    _refuse_first(flat, names, "v", "points out of the image", "a needle that lies in the image")
    array /= lengths[:, None]
    array.setflags(write=False)
    return array


def _refuse_first(bad: NDArray[np.bool_], names: tuple[str, ...], what: str, problem: str, allowed: str) -> None:
    if bad.any():
        name = names[int(np.argmax(bad))]
        raise InputError(f"{what} of pose {name} {problem}", where="recording", allowed=allowed)
