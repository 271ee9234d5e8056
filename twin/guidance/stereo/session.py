"""A stereo session by its devices alone: calibrate, map the head, then bring the ball to every target."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.twin.devices import Arm, Operator
from puncture_twin.twin.guidance.stereo.detection import Detections, Detector, Search, in_space, look_at
from puncture_twin.twin.guidance.stereo.guide import Guide, JointGuide
from puncture_twin.twin.guidance.stereo.planned import carried_rod, workcell_checker
from puncture_twin.twin.guidance.stereo.robot_calibration import RobotCalibration
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.guidance.stereo.servo_law import (
    Mapping,
    SeenMarkers,
    ServoStop,
    StepLimits,
    configurations,
    map_head,
    path_upward,
    servo_step,
)
from puncture_twin.twin.guidance.stereo.servo_loop import Lost, Servoed, Task, look_again, path_contact, servo


class ImageReading(NamedTuple):
    """Markers and targets as they are read in the CT, image frame."""

    markers_m: Floats
    """Shape (n, 3), mm."""
    targets_m: Floats
    """Shape (k, 3), mm."""


def see_markers(
    case: ServoCase, calibration: RobotCalibration, detector: Detector, operator: Operator
) -> list[Detections]:
    """Pixels of every marker in every camera, found near where an operator points.

    Raises:
        NoAnswerError: A marker is not found.
    """
    radius_mm, limits, found = case.file.head.marker_diameter_mm / 2, case.file.servo, []
    for name in case.markers.names:
        near = operator.pointed_cp(name)
        searches = tuple(Search(camera, near, radius_mm, limits.search_px) for camera in calibration.cameras)
        detections = look_at(detector, searches, limits.frames)
        if isinstance(detections, Lost):
            raise NoAnswerError(f"marker {name}: {detections.reason}", code="marker_not_seen")
        found.append(detections)
    return found


class Mapped(NamedTuple):
    """The head in C, and the estimates of ball and target that the case asks for."""

    mapping: Mapping
    guide: Guide


def map_markers(
    case: ServoCase, calibration: RobotCalibration, detector: Detector, operator: Operator, reading: ImageReading
) -> Mapped:
    """The head in C, from its markers' pixels and their readings.

    Raises:
        NoAnswerError: A marker is not found.
    """
    seen = see_markers(case, calibration, detector, operator)
    points = [in_space(calibration.cameras, detections) for detections in seen]
    markers = SeenMarkers(np.concatenate([p.points_c for p in points]), np.concatenate([p.covariance for p in points]))
    names, where = case.markers.names, f"{case.path}: mapping"
    mapping = map_head(names, markers, reading.markers_m, case.errors.marker_mm, reading.targets_m, where=where)
    kind = JointGuide if case.file.servo.estimate == "joint" else Guide
    return Mapped(mapping, kind(case, calibration, mapping, seen, reading.markers_m, detector))


@dataclass(frozen=True, eq=False)
class Aims:
    """Where the arm is sent for some of a case's targets, by calibration and mapping alone.

    Attributes:
        numbers: Which of the case's targets.
        q_hover: Shape (n, 6), rad: above each.
        q_aim: Shape (n, 6), rad: the ball on it.
        task: Limits of the servo, and the checker with the head where it is believed to be.
        expected_tre_mm: Shape (n,), what the mapping expects of itself there (rms), mm.
    """

    numbers: tuple[int, ...]
    q_hover: Floats
    q_aim: Floats
    task: Task
    expected_tre_mm: Floats

    def bring(self, row: int, arm: Arm) -> Servoed | None:
        """Move the ball from above a target onto it by the robot alone; a path that touches is not moved along.

        Returns:
            Why it was not; None where it was.
        """
        contact = path_contact(self.task.checker, np.stack([self.q_hover[row], self.q_aim[row]]))
        if contact is not None:
            return Servoed(ServoStop.CONTACT, (), self.q_hover[row], f"{contact.body} and {contact.other}")
        arm.move_jp(self.q_aim[row])
        return None

    def correct(self, row: int, guide: Guide, arm: Arm) -> Servoed:
        """Servo the ball onto a target, from where `bring` left it."""
        return servo(self.task, self.q_aim[row], guide.look, arm)


def step_limits(case: ServoCase) -> StepLimits:
    """What one step of the servo may do."""
    limits = case.file.servo
    joint_step, drift = np.radians([limits.max_joint_step_deg, limits.max_drift_deg]).tolist()
    return StepLimits(limits.max_step_mm, joint_step, drift, limits.joints)


def aims_of(
    case: ServoCase,
    calibration: RobotCalibration,
    mapping: Mapping,
    targets_m: Floats,
    wanted: Sequence[str] | None = None,
) -> Aims:
    """Where the arm is sent for the case's targets, or for those that are wanted.

    Args:
        targets_m: Shape (k, 3), mm, as they are read in the image.
        wanted: Names; None for all.

    Raises:
        NoAnswerError: A target cannot be reached.
    """
    rod = carried_rod(case)
    chosen = [i for i, name in enumerate(case.targets.names) if wanted is None or name in wanted]
    checker = workcell_checker(case, calibration.T_base_c @ mapping.T_c_m)
    aims_base = apply(calibration.T_base_c, mapping.to_c(targets_m[chosen]))
    hovers = path_upward(rod, aims_base, case.file.servo.hover_mm)
    q = configurations(rod, np.concatenate([aims_base, hovers]), checker, first=calibration.branch).q
    limits, steps = case.file.servo, step_limits(case)
    task = Task(rod, calibration.T_base_c, limits.tolerance_mm, limits.max_steps, limits.looks, steps, checker)
    expected = mapping.expected_tre_mm(targets_m, case.errors.target_mm)[chosen]
    return Aims(tuple(chosen), q[len(chosen) :], q[: len(chosen)], task, expected)


def follow(
    case: ServoCase, guide: Guide, T_base_c: Floats, targets_m: Floats, stops: Sequence[tuple[str, Floats]], arm: Arm
) -> Iterator[dict[str, Any]]:
    """What a session's looks at the ball say, stop by stop, as plain values: mm and degrees; None of a lost ball.

    Args:
        T_base_c: Shape (4, 4), mm, as calibrated.
        targets_m: Shape (k, 3), mm, in the image.
        stops: Name of the target, and joints (6,), rad.
        arm: Moves to each.
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
