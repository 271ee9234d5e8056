"""Recordings of the self-calibration as files: CSV, one line a pose.

Frames and letters are those of :class:`axp_ybq.recording.Recording`.
"""

from __future__ import annotations

import csv
import io
from itertools import product
from pathlib import Path
from types import MappingProxyType

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import atomic, decode_text, is_folder, read_input
from puncture_twin.planning.formats.points import joint_readings, row_numbers
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording

FILE_NAME = "recording.csv"
"""Name of the file that a folder is searched for."""

MAX_BYTES = 50_000_000
"""More than 50,000 poses: no calibration needs so many, and a larger file is likely something else."""


def recording_file(path: Path) -> Path:
    """The CSV itself, also of a folder that holds ``recording.csv``."""
    return path / FILE_NAME if is_folder(path) else path


def read_recording(path: Path) -> Recording:
    """Read a recording from its CSV, or from ``recording.csv`` in a folder.

    Columns: ``name``; ``A_r11 .. A_r33, A_x_mm, A_y_mm, A_z_mm``; the same for B; ``P_u_mm, P_v_mm`` (or ``_px``); and,
    where directions were measured, ``v_x, v_y`` or ``v_x, v_y, v_z``, and behind them, where it was measured too, how
    much of the shaft shows, ``shaft_mm``; and, where the joints were recorded,
    ``A_q1_deg .. A_q6_deg, B_q1_deg .. B_q6_deg``; and, behind these, the direction of each joint's last rotation
    (1, -1; 0 where unknown), ``A_turn1 .. B_turn6``. Lines that start with # are passed over.

    Raises:
        InputError: Another header, a field that is no finite number, or a matrix that is no rigid motion.
    """
    file = recording_file(path)
    return parse_recording(read_input(file, max_bytes=MAX_BYTES, where=str(file)), file)


def parse_recording(content: bytes, file: Path) -> Recording:
    """Parse a recording that has been read, like `read_recording`; it is not opened again.

    Raises:
        InputError: As `read_recording`, but for reading.
    """
    text = decode_text(content, str(file))
    try:
        rows = [row for row in csv.reader(io.StringIO(text), strict=True) if row and not row[0].startswith("#")]
    except csv.Error as error:
        what = f"is not a CSV file ({error})"
        raise InputError(what, where=file, allowed="one line per pose, with numbers", code="not_csv") from error
    header = tuple(cell.strip() for cell in rows[0]) if rows else ()
    if header not in KINDS:
        allowed = ", ".join(columns(False, (3, 1), 24))
        refuse(f"columns {', '.join(header)[:200]}", f"{file}, header", allowed, "wrong_columns")
    pixels, (width, shaft), behind = KINDS[header]
    places = (f"{file}, row {i}" for i in range(2, len(rows) + 1))
    values = np.array([row_numbers(row, header, header[1:], at) for row, at in zip(rows[1:], places, strict=True)])
    if values.size == 0:
        refuse("no pose", file, "one row per pose", "empty")
    names = tuple(row[0].strip() for row in rows[1:])
    try:
        first = 26 + width + shaft
        v, shaft_mm = values[:, 26 : 26 + width] if width else None, values[:, first - 1] if shaft else None
        q_probe, q_needle = None, None
        if behind:
            parts = np.split(values[:, first : first + 12], 2, axis=1)
            q_probe, q_needle = (joint_readings(part, "deg", where="joints", names=names) for part in parts)
        turn_probe, turn_needle = np.split(values[:, first + 12 :], 2, axis=1) if behind == 24 else (None, None)
        A, B = (pose(part[:, :9].reshape(-1, 3, 3), part[:, 9:]) for part in (values[:, :12], values[:, 12:24]))
        joints = (q_probe, q_needle, turn_probe, turn_needle)
        return Recording(A, B, values[:, 24:26], v, names, pixels, *joints, shaft_mm)
    except InputError as error:
        raise error.at(f"{file}: {error.where}") from error


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
            columns(recording.pixels, (width, int(recording.shaft_mm is not None)), 6 * len(joints + turns))
        )
        writer.writerows([name, *map(repr, row)] for name, row in zip(recording.names, values.tolist(), strict=True))


def _row_major(T: Floats) -> Floats:
    return np.column_stack([T[:, :3, :3].reshape(-1, 9), T[:, :3, 3]])


def columns(pixels: bool, direction: tuple[int, int], behind: int) -> tuple[str, ...]:
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


CHOICES = product((False, True), ((0, 0), (2, 0), (3, 0), (2, 1), (3, 1)), (0, 12, 24))

KINDS = MappingProxyType({columns(*choice): choice for choice in CHOICES})
"""Every header that is read: whether P is in pixels, columns of direction and shaft, and how many are behind them."""
