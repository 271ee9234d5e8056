"""Calibration by the robot: its ball at twelve points calibrates the cameras, defines C, and ties the robot to it.

A coordinate measuring arm measures each point once, in its own frame: that is C. Each camera is calibrated from the
ball's images against those points; r_T_c is the rigid fit of where the robot believes it had the ball (Liu 2007).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.collision.state_checker import StateChecker
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.twin.devices import Arm, MeasuringArm
from puncture_twin.twin.guidance.stereo.cameras.calibration import CameraCalibration, calibrate
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera
from puncture_twin.twin.guidance.stereo.detection import Detector, Search, look_at
from puncture_twin.twin.guidance.stereo.planned import calibrating_rod, grid_points, planned_cameras
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.guidance.stereo.servo_law import Posture, ball_base, configurations
from puncture_twin.twin.guidance.stereo.servo_loop import Lost, path_contact

FIRST_SEARCH_PX = 80.0
"""Before the calibration the cameras stand only about where they were planned."""


@dataclass(frozen=True, eq=False)
class RobotCalibration:
    """Result of a calibration with k points.

    Attributes:
        cameras: The calibrated cameras.
        T_base_c: Shape (4, 4), mm: r_T_c.
        q_command: Shape (k, 6), rad: where the arm said that it rests.
        measured_c: Shape (k, 3), mm: the measuring arm's readings.
        pixels: Shape (c, k, 2).
        covariances: Shape (c, k, 2, 2), px^2.
        rms_px: Residual of each camera.
        robot_residual_mm: Shape (k,): what the rigid fit leaves; mostly the robot's own error.
        branch: Of the inverse kinematics; the arm's errors are known on this one.
    """

    cameras: tuple[Camera, ...]
    T_base_c: Floats
    q_command: Floats
    measured_c: Floats
    pixels: Floats
    covariances: Floats
    rms_px: tuple[float, ...]
    robot_residual_mm: Floats
    branch: int


def calibration_commands(case: ServoCase, checker: StateChecker) -> Posture:
    """Joints that put the ball on the calibration's points, along a path that touches nothing.

    Args:
        checker: Checks contacts; the head is not there yet.

    Raises:
        NoAnswerError: The arm cannot go there.
    """
    q_command, branch = configurations(calibrating_rod(case), grid_points(case), checker)
    for number, (start, end) in enumerate(pairwise(q_command), start=2):
        contact = path_contact(checker, np.stack([start, end]))
        if contact is not None:
            what = f"calibration: {contact.body} would touch {contact.other} on the way to point {number}"
            raise NoAnswerError(what, code="motion_touches")
    return Posture(q_command, branch)


def calibrate_by_robot(
    case: ServoCase, commands: Posture, arm: Arm, touch: MeasuringArm, detector: Detector
) -> RobotCalibration:
    """Move to the points, detect, measure, and fit.

    Args:
        commands: Joints that put the ball on the points.
        arm: Carries it there.

    Raises:
        NoAnswerError: A ball is not found.
        InputError: The points do not determine a camera.
    """
    rod, reached = calibrating_rod(case), []
    measured, detections, radius_mm = [], [], case.file.tool.ball_diameter_mm / 2
    for number, q in enumerate(commands.q, start=1):
        arm.move_jp(q)
        reached.append(arm.measured_jp())
        measured.append(touch.measured_cp())
        searches = tuple(Search(one, measured[-1], radius_mm, FIRST_SEARCH_PX) for one in planned_cameras(case))
        seen = look_at(detector, searches, case.file.servo.frames)
        if isinstance(seen, Lost):
            raise NoAnswerError(f"calibration, point {number}: {seen.reason}", code="ball_not_found")
        detections.append(seen)
    measured_c, q_command = np.array(measured), np.array(reached)
    pixels = np.stack([s.pixels for s in detections], axis=1)
    covariances = np.stack([s.covariances for s in detections], axis=1)
    cameras = _cameras(case, measured_c, pixels)
    T_base_c = fit_rigid(measured_c, ball_base(rod, q_command))
    residual = np.linalg.norm(apply(T_base_c, measured_c) - ball_base(rod, q_command), axis=1)
    return RobotCalibration(
        tuple(found.camera for found in cameras),
        T_base_c,
        q_command,
        measured_c,
        pixels,
        covariances,
        tuple(found.rms_px for found in cameras),
        np.asarray(residual),
        commands.branch,
    )


def _cameras(case: ServoCase, measured_c: Floats, pixels: Floats) -> list[CameraCalibration]:
    """Each camera from the ball's images."""
    plan = case.file.cameras
    names = tuple(f"P{number}" for number in range(1, len(measured_c) + 1))
    return [
        calibrate(
            measured_c,
            seen,
            plan.size_px,
            names=names,
            distortion=plan.model_distortion,
            where=f"camera {number}",
        )
        for number, seen in enumerate(pixels, start=1)
    ]
