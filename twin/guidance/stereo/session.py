"""A stereo session by its devices alone: calibrate, map the head, bring the ball to every target; and a folder of one.

The robot presents its ball at twelve points: it calibrates the cameras, defines C, and ties the robot to it. A
coordinate measuring arm measures each point once, in its own frame: that is C. Each camera is calibrated from the
ball's images against those points; r_T_c is the rigid fit of where the robot believes it had the ball (Liu 2007).

A recording is written while a session runs, and read as devices again. ``points.csv`` has a row for each point of the
calibration, with the joints that were commanded and the measuring arm's reading in C; ``markers.csv`` where an operator
pointed, in C; ``stops.csv`` the joints at which the ball was looked at, with the target. ``markers_image.csv`` and
``targets_image.csv`` are the readings in the CT, where they are not the case's. A picture is
``<table>_<row>_<camera>_<n>.png``, all counted from 1, 8 bit grey, as large as the case says.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError, refuse
from puncture_twin.planning.base.files import is_plain_file, read_input
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.formats.csv_table import Layout, parse_table, table_text
from puncture_twin.planning.formats.points import NamedPoints, joint_readings, read_points, write_points
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Unit
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.twin.devices import Arm, Cameras, GreyImage, MeasuringArm, Operator
from puncture_twin.twin.guidance.stereo.ball import Detections, Detector, in_space, look_at
from puncture_twin.twin.guidance.stereo.camera import Camera
from puncture_twin.twin.guidance.stereo.camera_calibration import Points, calibrate
from puncture_twin.twin.guidance.stereo.joint_model import (
    Adjusted,
    Guess,
    NeedleError,
    Observed,
    adjust,
    open_loop_error,
    servoed_error,
)
from puncture_twin.twin.guidance.stereo.servo_case import (
    ServoCase,
    calibrating_rod,
    carried_rod,
    grid_points,
    planned_cameras,
    workcell_checker,
)
from puncture_twin.twin.guidance.stereo.servo_law import (
    Lost,
    Mapping,
    Posture,
    Seen,
    Servoed,
    ServoStop,
    StepLimits,
    Task,
    ball_base,
    ball_jacobian,
    configurations,
    look_again,
    map_head,
    path_contact,
    servo_step,
)
from puncture_twin.twin.pictures import parse_png, png_bytes

FIRST_SEARCH_PX = 80.0
"""Before the calibration the cameras stand only about where they were planned."""


@dataclass(frozen=True, eq=False)
class RobotCalibration:
    """Result of a calibration with k points."""

    cameras: tuple[Camera, ...]
    T_base_c: Floats  # shape (4, 4), mm: r_T_c
    q_command: Floats  # shape (k, 6), rad, at which the arm said that it rests
    measured_c: Floats  # shape (k, 3), mm, by the measuring arm
    pixels: Floats  # shape (c, k, 2)
    covariances: Floats  # shape (c, k, 2, 2), px^2
    rms_px: tuple[float, ...]  # of each camera
    robot_residual_mm: Floats  # shape (k,), of the rigid fit: mostly the robot's own error
    branch: int  # of the inverse kinematics, where its errors are known


def calibration_commands(case: ServoCase, checker: CellChecker) -> Posture:
    """Joints that put the ball on the calibration's points, along a path that touches nothing; without the head.

    Raises:
        NoAnswerError: The arm cannot go there.
    """
    commands = configurations(calibrating_rod(case), grid_points(case), checker)
    for number, (start, end) in enumerate(pairwise(commands.q), start=2):
        contact = path_contact(checker, np.stack([start, end]))
        if contact is not None:
            what = f"calibration: {contact.body} would touch {contact.other} on the way to point {number}"
            raise NoAnswerError(what, code="motion_touches")
    return commands


def calibrate_by_robot(
    case: ServoCase, commands: Posture, arm: Arm, touch: MeasuringArm, detector: Detector
) -> RobotCalibration:
    """Move to the points by the commanded joints, detect, measure, and fit.

    Raises:
        NoAnswerError: A ball is not found.
        InputError: The points do not determine a camera.
    """
    plan, reached = case.file.cameras, []
    measured, detections, radius_mm = [], [], case.file.tool.ball_diameter_mm / 2
    for number, q in enumerate(commands.q, start=1):
        arm.move_jp(q)
        reached.append(arm.measured_jp())
        measured.append(touch.measured_cp())
        frames = case.file.servo.frames
        seen = look_at(detector, planned_cameras(case), measured[-1], radius_mm, FIRST_SEARCH_PX, frames)
        if isinstance(seen, Lost):
            raise NoAnswerError(f"calibration, point {number}: {seen.reason}", code="ball_not_found")
        detections.append(seen)
    measured_c, q_command = np.array(measured), np.array(reached)
    pixels = np.stack([s.pixels for s in detections], axis=1)
    names, lens = [f"P{number}" for number in range(1, len(measured_c) + 1)], plan.model_distortion
    cameras = [
        calibrate(measured_c, seen, plan.size_px, names=names, distortion=lens, where=f"camera {number}")
        for number, seen in enumerate(pixels, start=1)
    ]
    balls_base = ball_base(calibrating_rod(case), q_command)
    T_base_c = fit_rigid(measured_c, balls_base)
    return RobotCalibration(
        tuple(found.camera for found in cameras),
        T_base_c,
        q_command,
        measured_c,
        pixels,
        np.stack([s.covariances for s in detections], axis=1),
        tuple(found.rms_px for found in cameras),
        np.linalg.norm(apply(T_base_c, measured_c) - balls_base, axis=1),
        commands.branch,
    )


@dataclass(eq=False)
class Guide:
    """The paper's chain: calibrated cameras triangulate the ball; the mapping gives the target."""

    case: ServoCase
    calibration: RobotCalibration
    mapping: Mapping
    markers: list[Detections]
    markers_m: Floats  # shape (n, 3), mm, as the image has them
    detector: Detector

    def __post_init__(self) -> None:
        calibration = self.calibration
        self._held = carried_rod(self.case)
        self._T_c_base = np.asarray(np.linalg.inv(calibration.T_base_c))
        self._q = [*calibration.q_command]
        self._pixels = [*calibration.pixels.transpose(1, 0, 2)]
        self._covariances = [*calibration.covariances.transpose(1, 0, 2, 3)]
        self._balls = [*calibration.measured_c]
        self._found: Adjusted | None = None
        self.target_m = np.zeros(3)
        self.target_c = np.zeros(3)

    def aim_at(self, target_m: Floats) -> None:
        """Set the target, shape (3,), mm, image frame."""
        self.target_m = target_m
        self.target_c = self.mapping.to_c(target_m)

    def look(self, q_command: Floats) -> Seen | Lost:
        """Measure the ball in new images, searched where the arm was sent, (6,), rad; returns ball and target."""
        predicted, limits = apply(self._T_c_base, ball_base(self._held, q_command)), self.case.file.servo
        cameras, radius_mm = self.calibration.cameras, self.case.file.tool.ball_diameter_mm / 2
        detections = look_at(self.detector, cameras, predicted, radius_mm, limits.search_px, limits.frames)
        if isinstance(detections, Lost):
            return detections
        self._q.append(q_command)
        self._pixels.append(detections.pixels)
        self._covariances.append(detections.covariances)
        return self._assess(detections)

    def _assess(self, detections: Detections) -> Seen:
        points = in_space(self.calibration.cameras, detections)
        self._balls.append(points.points_c[0])
        return Seen(points.points_c[0], self.target_c, points.covariance[0])

    def needle_unseen(self, q_command: Floats) -> NeedleError | None:
        """Predicted needle at commanded joints (6,), rad; None where the estimate does not settle."""
        return self._believed(lambda adjusted: open_loop_error(adjusted, q_command, self.target_m))

    def corrected_jp(self, q_command: Floats) -> Floats | None:
        """Joints (6,), rad, near the commanded ones that bring the ball onto the target by the arm's estimated errors.

        That is what calibrating the arm is worth without looking again; None where the estimate does not settle.
        """
        if (believed := self.needle_unseen(q_command)) is None:
            return None
        R_base_m = self.calibration.T_base_c[:3, :3] @ self.mapping.T_c_m[:3, :3]
        missed = np.append(R_base_m @ believed.offset_m, np.zeros(3))
        return np.asarray(q_command - np.linalg.solve(ball_jacobian(self._held, q_command), missed))

    def needle_seen(self) -> NeedleError | None:
        """Predicted needle after the last image with its ball; None where the estimate does not settle."""
        return self._believed(lambda adjusted: servoed_error(adjusted, -1, self.target_m))

    def _believed(self, estimate: Callable[[Adjusted], NeedleError]) -> NeedleError | None:
        try:
            return estimate(self.adjusted())
        except NoAnswerError:
            return None

    def adjusted(self) -> Adjusted:
        """The joint estimate of everything measured so far.

        Raises:
            NoAnswerError: It does not settle.
        """
        if self._found is None or len(self._found.unknowns.balls_c) < len(self._balls):
            guess, start = Guess(self._T_c_base, self.mapping.T_c_m, np.array(self._balls)), None
            if self._found is not None:
                last = self._found.unknowns
                new = np.array(self._balls[len(last.balls_c) :]).reshape(-1, 3)
                start = last._replace(balls_c=np.concatenate([last.balls_c, new]))
            self._found = adjust(self.observed(), guess, start)
        return self._found

    def observed(self) -> Observed:
        """Everything measured so far: the stays of the calibration first, then every look that found the ball."""
        case, marks = self.case, self.markers
        return Observed(
            planned_cameras(case),
            self._held,
            case.errors,
            np.array(self._q),
            np.stack(self._pixels, axis=1),
            self._of_pixels(np.stack(self._covariances, axis=1)),
            self.calibration.measured_c,
            np.stack([m.pixels for m in marks], axis=1),
            self._of_pixels(np.stack([m.covariances for m in marks], axis=1)),
            self.markers_m,
        )

    def _of_pixels(self, measured: Floats) -> Floats:
        """Covariances (c, n, 2, 2), px^2: what is declared, else what the tracker reported of each image."""
        declared = self.case.errors.ball_px
        return measured if declared is None else np.broadcast_to(declared**2 * np.eye(2), measured.shape)


class JointGuide(Guide):
    """The joint estimate: every image of the session, the servo's own among them, is adjusted together."""

    def aim_at(self, target_m: Floats) -> None:
        """Set the target; it moves as the estimate does."""
        self.target_m = target_m
        self.target_c = self.adjusted().offset(0, target_m).target_c

    def _assess(self, detections: Detections) -> Seen:
        super()._assess(detections)
        offset = self.adjusted().offset(-1, self.target_m)
        self.target_c = offset.target_c
        return Seen(offset.ball_c, offset.target_c, offset.ball_covariance)


class ImageReading(NamedTuple):
    """Markers (n, 3) and targets (k, 3) as they are read in the CT, image frame, mm."""

    markers_m: Floats  # shape (n, 3), mm
    targets_m: Floats  # shape (k, 3), mm


def map_markers(
    case: ServoCase, calibration: RobotCalibration, detector: Detector, operator: Operator, reading: ImageReading
) -> Guide:
    """The head in C, from its markers' pixels, found near where an operator points, and their readings.

    Raises:
        NoAnswerError: A marker is not found.
    """
    radius_mm, limits, seen = case.file.head.marker_diameter_mm / 2, case.file.servo, []
    for name in case.markers.names:
        near = operator.pointed_cp(name)
        detections = look_at(detector, calibration.cameras, near, radius_mm, limits.search_px, limits.frames)
        if isinstance(detections, Lost):
            raise NoAnswerError(f"marker {name}: {detections.reason}", code="marker_not_seen")
        seen.append(detections)
    points = [in_space(calibration.cameras, detections) for detections in seen]
    markers = Points(np.concatenate([p.points_c for p in points]), np.concatenate([p.covariance for p in points]))
    (markers_m, targets_m), where = reading, f"{case.path}: mapping"
    mapping = map_head(case.markers.names, markers, markers_m, case.errors.marker_mm, targets_m, where)
    kind = JointGuide if case.file.servo.estimate == "joint" else Guide
    return kind(case, calibration, mapping, seen, markers_m, detector)


@dataclass(frozen=True, eq=False)
class Aims:
    """Commands of the arm for some of a case's targets, by calibration and mapping alone."""

    numbers: tuple[int, ...]  # of the targets
    q_hover: Floats  # shape (n, 6), rad: above each
    q_aim: Floats  # shape (n, 6), rad: the ball on it
    task: Task  # holds the servo's limits
    expected_tre_mm: Floats  # shape (n,), that the mapping expects of itself there (rms)

    def bring(self, row: int, arm: Arm) -> Servoed | None:
        """Move the ball from above a target onto it by the robot alone; where the path touches, say so and stay."""
        contact = path_contact(self.task.checker, np.stack([self.q_hover[row], self.q_aim[row]]))
        if contact is not None:
            return Servoed(ServoStop.CONTACT, (), self.q_hover[row], f"{contact.body} and {contact.other}")
        arm.move_jp(self.q_aim[row])
        return None


def step_limits(case: ServoCase) -> StepLimits:
    """Limits of one step of the servo."""
    limits = case.file.servo
    joint_step, drift = np.radians([limits.max_joint_step_deg, limits.max_drift_deg]).tolist()
    return StepLimits(limits.max_step_mm, joint_step, drift, limits.joints)


def aims_of(
    case: ServoCase, calibration: RobotCalibration, mapping: Mapping, targets_m: Floats, wanted: Sequence[str] | None
) -> Aims:
    """Commands for the case's targets (k, 3), mm, as they are read, or for those whose names are wanted.

    Raises:
        NoAnswerError: A target cannot be reached.
    """
    rod = carried_rod(case)
    chosen = [i for i, name in enumerate(case.targets.names) if wanted is None or name in wanted]
    checker = workcell_checker(case, calibration.T_base_c @ mapping.T_c_m)
    aims_base = apply(calibration.T_base_c, mapping.to_c(targets_m[chosen]))
    hovers = aims_base - case.file.servo.hover_mm * rod.R_base_flange[:, 2]  # farther back along the rod
    q = configurations(rod, np.concatenate([aims_base, hovers]), checker, first=calibration.branch).q
    limits, steps = case.file.servo, step_limits(case)
    task = Task(rod, calibration.T_base_c, limits.tolerance_mm, limits.max_steps, limits.looks, steps, checker)
    expected = mapping.expected_tre_mm(targets_m, case.errors.target_mm)[chosen]
    return Aims(tuple(chosen), q[len(chosen) :], q[: len(chosen)], task, expected)


def follow(
    case: ServoCase, guide: Guide, T_base_c: Floats, targets_m: Floats, stops: Sequence[tuple[str, Floats]], arm: Arm
) -> Iterator[dict[str, Any]]:
    """Readings of the ball in a session, stop by stop, as plain values: mm and degrees; None of a lost ball.

    T_base_c (4, 4), mm, is as calibrated, targets (k, 3), mm, are in the image; a stop is the name of a target and
    joints (6,), rad.
    """
    rod, limits, last, radius = carried_rod(case), step_limits(case), "", case.file.target.hit_radius_mm
    for name, q in stops:
        arm.move_jp(q)
        if name != last:
            guide.aim_at(targets_m[case.targets.names.index(name)])
            last = name
        seen = look_again(guide.look, q, case.file.servo.looks)
        row: dict[str, Any] = {"target": name, "joints_deg": np.degrees(q).tolist()}
        row |= dict.fromkeys(("lost", "error_c_mm", "error_mm", "needle_rms_mm", "p_hit", "next_joints_deg"))
        if isinstance(seen, Lost):
            yield {**row, "lost": seen.reason}
            continue
        error_c, needle = seen.target_c - seen.ball_c, guide.needle_seen()
        step = servo_step(rod, q, T_base_c[:3, :3] @ error_c, limits)  # where the servo would send the arm next
        row |= {"error_c_mm": error_c.tolist(), "error_mm": float(np.linalg.norm(error_c))}
        if needle is not None:
            row |= {"needle_rms_mm": needle.rms_mm, "p_hit": None if radius is None else needle.p_hit(radius)}
        yield row if step.stop else {**row, "next_joints_deg": np.degrees(step.q_path[-1]).tolist()}


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
    """One table of a recording: the first column's names, and what follows them, (n, k)."""

    names: tuple[str, ...]
    values: Floats  # shape (n, k): what follows the name


@dataclass
class Recorder:
    """Devices that are used through it, to a target, and all that they said: pictures at once, tables by `finish`."""

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
        """Joints at which the arm rests after a move."""
        return self.devices.measured_jp()

    def measured_cp(self) -> Floats:
        """The measuring arm's reading: a point of the calibration."""
        point = self.devices.measured_cp()
        self._begin(POINTS, f"P{len(self._rows[POINTS]) + 1}", *self._joints, *map(repr, point.tolist()))
        return point

    def pointed_cp(self, marker: str) -> Floats:
        """The point that the operator marks."""
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
    """Path of a picture; row, camera and number count from 1."""
    return folder / f"{table}_{row:03d}_{camera}_{number}.png"


@dataclass
class Replay:
    """A recording as devices: it answers what was recorded, in the order in which it was."""

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
        """The point that the operator marked, shape (3,), mm, C.

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
        contents = []
        for file, own in zip(IMAGE_POINTS, (markers, targets), strict=True):
            path = self.folder / file
            points = read_points(path, default_unit=Unit.MM) if is_plain_file(path) else own
            if set(points.names) != set(own.names):
                refuse(f"names {', '.join(points.names)}", path, f"the case's: {', '.join(own.names)}", "names_differ")
            contents.append(points.points[[points.names.index(name) for name in own.names]])
        return ImageReading(*contents)


def read_recording(folder: Path, size_px: tuple[int, int]) -> Replay:
    """The tables of a recording; its pictures, of (width, height), are read when they are looked at.

    Raises:
        InputError: A table is absent, has other columns, or a field that is no number.
    """
    tables = {}
    for table, header in COLUMNS.items():
        path = folder / f"{table}.csv"
        content = read_input(path, max_bytes=MAX_BYTES, where=str(path))
        layout = Layout({"all": header[1:]}, (frozenset({"all"}),))
        names, numbers, *_ = parse_table(content, path, layout, ("all",), first=header[0])
        if table == MARKERS and len(set(names)) < len(names):
            refuse(f"a marker appears twice: {', '.join(names)}", path, "each name once", "duplicate_name")
        tables[table] = RecordedTable(names, numbers["all"])
    for table in (POINTS, STOPS):
        joint_readings(tables[table].values[:, :6], "deg", where=folder / f"{table}.csv", names=tables[table].names)
    return Replay(folder, tables, size_px)
