"""Recordings of the self-calibration from outside: files, needles in pictures, and a calibration that refuses slips.

Frames and letters are those of :class:`axp_ybq.recording.Recording`. A CSV has a row per pose; pictures lie beside it.
The needle is detected in each, and one that does not show it is left out and named.

A recording that was written in another reading (inverse poses, swapped arms, metres) still has a best fit, with
residuals of centimetres, and no pose stands out because all are wrong. So where the reading as given does not fit, the
slips that people make are undone one by one; the one that then fits is named. A recording that fits in no reading is
refused too: its calibration would send the needle anywhere.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import cv2
import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats, Pixels
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import atomic, is_folder, read_input, unfinished_warnings
from puncture_twin.planning.base.provenance import Input, content_input
from puncture_twin.planning.formats.csv_table import (
    GroupedTable,
    Layout,
    parse_table,
    pose_columns,
    pose_names,
    pose_values,
    table_text,
)
from puncture_twin.planning.formats.points import joint_readings
from puncture_twin.planning.geometry.rigid import inverse, pose
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration, calibrate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import OPTIONAL, Recording
from puncture_twin.twin.guidance.ultrasound.needle_detector import (
    ENDS_AGREE_MM,
    RIDGE_MM,
    SHAFT_MM,
    Detection,
    Imager,
    detect,
)
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase
from puncture_twin.twin.pictures import SAME_SIZE, read_frames

FILE_NAME = "recording.csv"
"""Name of the file that a folder is searched for."""
MAX_BYTES = 50_000_000
"""More than 50,000 poses: no calibration needs so many, and a larger file is likely something else."""

GROUPS = MappingProxyType(
    {
        "A": pose_columns("A"),
        "B": pose_columns("B"),
        "P_mm": ("P_u_mm", "P_v_mm"),
        "P_w": ("P_w_mm",),
        "P_px": ("P_u_px", "P_v_px"),
        "v": ("v_x", "v_y"),
        "v_z": ("v_z",),
        "shaft": ("shaft_mm",),
        "picture": ("picture",),
        "frame": ("frame",),
        "pixel": ("pixel_mm",),
        "q": tuple(f"{arm}_q{i}_deg" for arm in "AB" for i in "123456"),
        "turn": tuple(f"{arm}_turn{i}" for arm in "AB" for i in "123456"),
    }
)
"""Columns behind the name, in their order."""

LAYOUT = Layout(
    GROUPS,
    any_of=(frozenset({"A", "q"}),),
    one_of=frozenset({"P_mm", "P_px", "picture"}),
    needs=MappingProxyType(
        {
            "P_w": "P_mm",
            "v_z": "v",
            "shaft": "v",
            "frame": "picture",
            "pixel": "picture",
            "turn": "q",
            "A": "B",
            "B": "A",
        }
    ),
)
"""Poses or joints, and one of three statements of where the tip is."""
COVERED = "something coloured covers the needle's tip"
PIXEL_MM = (0.01, 2.0)
"""Least and largest size of a pixel."""


class ReadRecording(NamedTuple):
    """A recording, and the files that it is made from."""

    recording: Recording
    inputs: tuple[Input, ...]
    warnings: tuple[str, ...]


def recording_file(path: Path) -> Path:
    """The CSV itself, also of a folder that holds ``recording.csv``."""
    return path / FILE_NAME if is_folder(path) else path


def read_recording(path: Path) -> Recording:
    """Read a recording that needs no case; see `open_recording`."""
    return open_recording(path, None).recording


def open_recording(path: Path, case: SelfcalCase | None) -> ReadRecording:
    """Read a recording from its CSV, or from ``recording.csv`` in a folder; see docs/reference/selfcal-recording.md.

    The case's arms turn joints into flanges, and its image is that of the pictures; None where the file says all by
    itself.

    Raises:
        InputError: Another header, a field that is no finite number, a matrix that is no rigid motion, a picture that
            is absent, damaged or of another size, or a pixel of no size or of two.
    """
    file = recording_file(path)
    content = read_input(file, max_bytes=MAX_BYTES, where=str(file))
    table = parse_table(content, file, LAYOUT, ("A", "B", "P_mm", "v", "q"), texts=frozenset({"picture"}))
    inputs = [content_input("recording", file.name, content)]
    seen = _seen(table, file, case, inputs) if "picture" in table.texts else None
    try:
        recording = _recording(table, seen, case)
    except InputError as error:
        raise error.at(f"{file}: {error.where}") from error
    warnings = () if seen is None else seen.warnings
    return ReadRecording(recording, tuple(inputs), (*unfinished_warnings(content, file.name), *warnings))


class _Seen(NamedTuple):
    """Needles detected in pictures: P, v (n, 2), shaft (n,), mm, NaN where there is none; and why."""

    P: Floats
    v: Floats
    shaft_mm: Floats  # shape (n,)
    missed: tuple[str, ...]
    warnings: tuple[str, ...]


def _recording(table: GroupedTable, seen: _Seen | None, case: SelfcalCase | None) -> Recording:
    numbers, names = dict(table.numbers), pose_names(table.names, len(table.names))
    if seen is not None:
        numbers |= {"P_mm": seen.P, "v": seen.v, "shaft": seen.shaft_mm[:, None]}
    joints: list[Floats | None] = [None, None]
    if "q" in numbers:
        both = np.split(numbers["q"], 2, axis=1)
        joints = [joint_readings(part, "deg", where="joints", names=names) for part in both]
    turns = np.split(numbers["turn"], 2, axis=1) if "turn" in numbers else [None, None]
    poses = list(table.poses.values())
    if not poses:
        if case is None:
            refuse("joints alone", "header", "columns A_r11 .. B_z_mm, or a case that names the arms", "missing_column")
        poses = [flange_pose(model, q) for model, q in zip(case.models, joints, strict=True) if q is not None]
    P = np.column_stack([numbers[key] for key in ("P_mm", "P_w", "P_px") if key in numbers])
    v = np.column_stack([numbers[key] for key in ("v", "v_z") if key in numbers]) if "v" in numbers else None
    shows = np.asarray(np.isfinite(P).all(axis=1))
    if not shows.any():
        refuse(f"none of {len(shows)} pictures shows a needle", "pictures", "pictures with a needle", "too_few_poses")
    shaft = numbers["shaft"][:, 0] if "shaft" in numbers else None
    optional = dict(zip(OPTIONAL, (v, shaft, *joints, *turns), strict=True))
    parts: dict[str, Any] = {key: None if one is None else one[shows] for key, one in optional.items()}
    parts["names"] = tuple(np.array(names)[shows].tolist())
    parts["missed"] = () if seen is None else tuple(one for one in zip(names, seen.missed, strict=True) if one[1])
    return Recording(poses[0][shows], poses[1][shows], P[shows], pixels="P_px" in numbers, **parts)


def _seen(table: GroupedTable, file: Path, case: SelfcalCase | None, inputs: list[Input]) -> _Seen:
    """The needle in every picture of a table, each file read once; the files join the inputs."""
    n, files = len(table.names), table.texts["picture"]
    frames = table.numbers["frame"][:, 0] if "frame" in table.numbers else np.ones(n)
    pairs = list(zip(files, frames.tolist(), strict=True))
    if len(set(pairs)) < n:
        twice = next(pair for i, pair in enumerate(pairs) if pair in pairs[:i])
        refuse(f"picture {twice[0]}, frame {twice[1]:g} twice", file, "each picture once", "duplicate_name")
    P, v, shaft, missed = np.full((n, 2), np.nan), np.full((n, 2), np.nan), np.full(n, np.nan), [""] * n
    coloured: dict[str, float] = {}
    imager: Imager | None = None
    by_file: dict[str, list[int]] = {}
    for row, name in enumerate(files):
        by_file.setdefault(name, []).append(row)
    for name, rows in by_file.items():
        path = file.parent / name
        if Path(name).name != name:
            refuse(f"picture {name[:100]!r}", file, "the name of a file beside it", "bad_value")
        read = read_frames(path)
        inputs.append(read.source)
        for row in rows:
            if frames[row] not in range(1, len(read.grey) + 1):
                refuse(f"frame {frames[row]:g} of {path.name}", file, f"1 to {len(read.grey)}", "out_of_range")
            size = _pixel_mm(table, row, read.pixel_mm, case, path)
            shown = int(frames[row]) - 1
            grey = _squared(read.grey[shown], size)
            colour = None if read.coloured is None else np.argwhere(read.coloured[shown])[:, ::-1] * np.array(size)
            if colour is not None and len(colour):
                coloured[table.names[row]] = len(colour) / read.grey[shown].size
            machine = Imager() if case is None else case.content.image.imager()
            own = replace(machine, rows=grey.shape[0], columns=grey.shape[1], pixel_mm=min(size))
            if imager is not None and own != imager:
                what = f"{own.columns} x {own.rows} pixels of {own.pixel_mm:g} mm"
                first = f"{imager.columns} x {imager.rows} of {imager.pixel_mm:g} mm, as {files[0]}"
                refuse(what, path, first, "wrong_size")
            imager, detection = own, detect(grey, own)
            if isinstance(detection, Detection) and colour is not None and _covers(colour, detection):
                missed[row] = COVERED
            elif isinstance(detection, Detection):
                P[row], v[row], shaft[row] = detection.tip_image, detection.direction_image, detection.shaft_mm
            else:
                missed[row] = detection.value
    if not coloured:
        return _Seen(P, v, shaft, tuple(missed), ())
    most = max(coloured, key=lambda name: coloured[name])
    extent = f"at most {100 * coloured[most]:.1f} % of one, {most}"
    warning = f"colour in {len(coloured)} pictures ({extent}): not searched for the needle"
    return _Seen(P, v, shaft, tuple(missed), (warning,))


def _covers(colour: Floats, detection: Detection) -> bool:
    """True where coloured pixels (n, 2), mm, lie on the needle's ridge near its tip."""
    offset, (along_u, along_v) = colour - detection.tip_image, detection.direction_image
    along, across = offset @ detection.direction_image, offset @ np.array([-along_v, along_u])
    return bool(((np.abs(across) < RIDGE_MM) & (along > -SHAFT_MM) & (along < ENDS_AGREE_MM)).any())


def _pixel_mm(
    table: GroupedTable, row: int, stated: tuple[float, float] | None, case: SelfcalCase | None, path: Path
) -> tuple[float, float]:
    sizes = [] if stated is None else [stated]
    if "pixel" in table.numbers:
        sizes.append((float(table.numbers["pixel"][row, 0]),) * 2)
    if case is not None and "pixel_mm" in case.content.image.model_fields_set:
        sizes.append((case.content.image.pixel_mm,) * 2)
    if not sizes:
        allowed = "a column pixel_mm, [image] pixel_mm in a case, or DICOM that states it"
        refuse("nothing states the size of its pixels", path, allowed, "pixel_size")
    if not np.allclose(sizes, sizes[0], rtol=SAME_SIZE):
        stated_text = " and ".join(f"{width:g} x {height:g}" for width, height in sizes)
        refuse(
            f"pixels of {stated_text} mm", path, "one size in file, column pixel_mm and [image] pixel_mm", "pixel_size"
        )
    if not PIXEL_MM[0] <= min(sizes[0]) <= max(sizes[0]) <= PIXEL_MM[1]:
        refuse(f"pixels of {sizes[0][0]:g} x {sizes[0][1]:g} mm", path, "{} to {} mm".format(*PIXEL_MM), "pixel_size")
    return sizes[0]


def _squared(grey: Pixels, size: tuple[float, float]) -> Pixels:
    """A picture with square pixels of the smaller edge; the middle of the first one stays where it is."""
    edge = min(size)
    if max(size) <= edge * (1 + SAME_SIZE):
        return grey
    rows, columns = (int((n - 1) * mm / edge) + 1 for n, mm in zip(grey.shape, size[::-1], strict=True))
    u, v = np.meshgrid(np.arange(columns) * edge / size[0], np.arange(rows) * edge / size[1])
    sampled = cv2.remap(grey, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
    return np.asarray(sampled, dtype=np.uint8)


def write_recording(recording: Recording, path: Path) -> None:
    """Write a recording as CSV, every number in full, whole or not at all.

    Raises:
        InputError: The file cannot be written.
    """
    parts = {"A": pose_values(recording.A), "B": pose_values(recording.B)}
    parts["P_px" if recording.pixels else "P_mm"] = recording.P[:, :2]
    parts["P_w"] = recording.P[:, 2:]
    if recording.v is not None:
        parts |= {"v": recording.v[:, :2], "v_z": recording.v[:, 2:]}
    if recording.shaft_mm is not None:
        parts["shaft"] = recording.shaft_mm[:, None]
    if recording.q_probe is not None and recording.q_needle is not None:
        parts["q"] = np.degrees(np.column_stack([recording.q_probe, recording.q_needle]))
    if recording.turn_probe is not None and recording.turn_needle is not None:
        parts["turn"] = np.column_stack([recording.turn_probe, recording.turn_needle])
    groups = [group for group in GROUPS if group in parts and parts[group].size]
    header = ("name", *(column for group in groups for column in GROUPS[group]))
    values = np.column_stack([parts[group] for group in groups]).tolist()
    rows = [(name, *row) for name, row in zip(recording.names, values, strict=True)]
    with atomic(path) as temporary:
        temporary.write_text(table_text(header, rows), encoding="utf-8")


def held_length_mm(case: SelfcalCase | None) -> float | None:
    """The needle's length where the case holds it."""
    return case.content.needle.length_mm if case is not None and case.content.hold_needle_length else None


def calibrate_case(recording: Recording, case: SelfcalCase | None, *, hold: bool = True) -> Calibration:
    """Calibrate with the case's noise and, where it is to be held, the needle's length."""
    noise = None if case is None or case.content.noise is None else case.content.noise.noise()
    length = held_length_mm(case) if hold else None
    arms = None if case is None or recording.q_probe is None else case.declared_arms
    return calibrate(recording, noise=noise, needle_length_mm=length, scale=recording.pixels, arms=arms)


Reading = Callable[[Recording], Recording]
SUSPECT_MM = 1.5
"""Residuals (rms) from which on other readings are tried: three times the usual ones."""
SOUND_MM = 5.0
"""Residuals (rms) beyond which nothing was calibrated, whatever the reason."""
BETTER = 1 / 3
"""A reading whose residuals are below this part of the given one's, and are not suspect, is the right one."""
LEAST_REACH_MM = 20.0
"""An arm whose flange never leaves this distance of its base was written in metres."""
ALLOWED = "A = T_base1_end1 and B = T_base2_end2 in mm, rotations by rows, P in mm"


def checked_calibration(
    recording: Recording, case: SelfcalCase | None, where: Path, *, hold: bool = True
) -> Calibration:
    """Calibration of a recording from outside, by `calibrate_case`; one that was read otherwise than meant is refused.

    Raises:
        InputError: Another reading fits and this one does not, or none does; or what `calibrate_case` refuses.
    """
    for name, T in (("A", recording.A), ("B", recording.B)):
        farthest = float(np.linalg.norm(T[:, :3, 3], axis=1).max())
        if farthest < LEAST_REACH_MM:
            what = f"the flange of {name} is never farther than {farthest:.3g} mm from its base: metres?"
            refuse(what, where, ALLOWED, "wrong_unit")
    try:
        calibration = calibrate_case(recording, case, hold=hold)
    except InputError as error:
        rms_mm = _residual_mm(lambda r: _read(r, r.A, r.B, r.P), recording)
        if rms_mm > SUSPECT_MM:
            _refuse_slip(recording, rms_mm, where)
        raise error.at(where) from error
    if calibration.rms_mm > SUSPECT_MM:
        _refuse_slip(recording, calibration.rms_mm, where)
    if calibration.rms_mm > SOUND_MM:
        what = f"residuals of {calibration.rms_mm:.3g} mm (rms): the poses and the image do not belong together"
        refuse(what, where, f"residuals up to {SOUND_MM:g} mm; {ALLOWED}", "residuals_too_large")
    return calibration


def _refuse_slip(recording: Recording, rms_mm: float, where: Path) -> None:
    for slip, undo in SLIPS.items():
        other = _residual_mm(undo, recording)
        if other < SUSPECT_MM and other < BETTER * rms_mm:
            as_given = f"residuals {rms_mm:.3g} mm" if np.isfinite(rms_mm) else "no fit"
            what = f"it does not fit as given ({as_given}), but it fits ({other:.2g} mm rms) if {slip}"
            refuse(what, where, ALLOWED, "recording_slip")


def _residual_mm(undo: Reading, recording: Recording) -> float:
    """Residuals (rms) of the other reading over all poses, mm; infinite where it cannot be calibrated."""
    try:
        return calibrate(undo(recording), scale=recording.pixels, direction=False).rms_mm
    except InputError:
        return float("inf")


def _read(recording: Recording, A: Floats, B: Floats, P: Floats) -> Recording:
    return Recording(A, B, P, None, recording.names, recording.pixels)


def _later(recording: Recording, rows: int) -> Recording:
    """The poses with the tip of the row that follows so many rows later."""
    first, last = (slice(0, -rows), slice(rows, None)) if rows > 0 else (slice(-rows, None), slice(0, rows))
    names = recording.names[first]
    return Recording(recording.A[first], recording.B[first], recording.P[last], None, names, recording.pixels)


def _transposed(T: Floats) -> Floats:
    return pose(T[:, :3, :3].transpose(0, 2, 1), T[:, :3, 3])


def _longer(T: Floats, factor: float) -> Floats:
    return pose(T[:, :3, :3], factor * T[:, :3, 3])


SLIPS: Mapping[str, Reading] = MappingProxyType(
    {
        "A and B are inverse (base in flange)": lambda r: _read(r, inverse(r.A), inverse(r.B), r.P),
        "A is inverse (base in flange)": lambda r: _read(r, inverse(r.A), r.B, r.P),
        "B is inverse (base in flange)": lambda r: _read(r, r.A, inverse(r.B), r.P),
        "the arms A and B are swapped": lambda r: _read(r, r.B, r.A, r.P),
        "the arms are swapped and inverse": lambda r: _read(r, inverse(r.B), inverse(r.A), r.P),
        "the rotations of A and B are written by columns": lambda r: _read(r, _transposed(r.A), _transposed(r.B), r.P),
        "the rotations of A are written by columns": lambda r: _read(r, _transposed(r.A), r.B, r.P),
        "the rotations of B are written by columns": lambda r: _read(r, r.A, _transposed(r.B), r.P),
        "A and B are in cm": lambda r: _read(r, _longer(r.A, 10), _longer(r.B, 10), r.P),
        "P is in metres": lambda r: _read(r, r.A, r.B, r.P * 1000),
        "P is in cm": lambda r: _read(r, r.A, r.B, r.P * 10),
        "P_w has the other sign": lambda r: _read(r, r.A, r.B, r.P * np.array([1, 1, -1])[: r.P.shape[1]]),
        "each picture belongs to the row before it": lambda r: _later(r, 1),
        "each picture belongs to the row behind it": lambda r: _later(r, -1),
    }
)
"""What people write instead of `ALLOWED`, in words, and how it is undone."""
