"""Calibration by the robot: its ball at twelve points calibrates the cameras, defines C, and ties the robot to it.

A coordinate measuring arm measures each point once, in its own frame: that is C. Each camera is calibrated from the
ball's images against those points; r_T_c is the rigid fit of where the robot believes it had the ball (Liu 2007).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.collision.state_checker import StateChecker
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.twin.guidance.stereo.cameras.calibration import CameraCalibration, calibrate
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera
from puncture_twin.twin.guidance.stereo.detection import Detector, LocatedPair, Search, look_at
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.guidance.stereo.servo_law import CarriedRod, ball_base, configurations, rod_orientation
from puncture_twin.twin.guidance.stereo.servo_loop import Lost, path_contact
from puncture_twin.twin.guidance.stereo.stereo_workcell import StereoWorkcell, planned_cameras

GRID = (3, 2, 2)
"""Points along the base's x, y and z."""

FIRST_SEARCH_PX = 80.0
"""Before the calibration the cameras stand only about where they were planned."""


@dataclass(frozen=True, eq=False)
class RobotCalibration:
    """Result of a calibration with k points.

    Attributes:
        cameras: The calibrated cameras.
        T_base_c: Shape (4, 4), mm: r_T_c.
        q_command: Shape (k, 6), rad.
        measured_c: Shape (k, 3), mm: the measuring arm's readings.
        pixels: Shape (c, k, 2).
        covariances: Shape (c, k, 2, 2), px^2.
        rms_px: Residual of each camera.
        robot_residual_mm: Shape (k,): what the rigid fit leaves; mostly the robot's own error.
        q_true: Shape (k, 6), rad: true joints; for the twin alone.
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
    q_true: Floats
    branch: int


def carried_rod(case: ServoCase, workcell: StereoWorkcell) -> CarriedRod:
    """The nominal arm with the case's rod, in the orientation of the targets."""
    tool = case.file.tool
    return CarriedRod(workcell.model, tool.rod_mm, rod_orientation(float(np.radians(tool.tilt_deg))))


def calibrating_rod(case: ServoCase, workcell: StereoWorkcell) -> CarriedRod:
    """The nominal arm with the case's rod, in the orientation of the calibration."""
    tilt = case.file.calibration.tilt_deg
    rod = carried_rod(case, workcell)
    return rod if tilt is None else rod._replace(R_base_flange=rod_orientation(float(np.radians(tilt))))


def grid_points(case: ServoCase) -> Floats:
    """The calibration's points, base frame, shape (12, 3), mm: neighbours in the order of the arm's path."""
    cal = case.file.calibration
    steps = np.array(list(product(*(np.linspace(-0.5, 0.5, count) for count in GRID))))
    return np.asarray(cal.center_mm + steps * cal.size_mm)


def calibrate_by_robot(
    workcell: StereoWorkcell, detector: Detector, checker: StateChecker, rng: np.random.Generator
) -> RobotCalibration:
    """Move to the points, detect, measure, and fit.

    Args:
        workcell: The true workcell.
        detector: Takes the images.
        checker: Checks contacts; the head is not there yet.
        rng: For the arm's repeatability and the measuring arm.

    Raises:
        NoAnswerError: The arm cannot go there, or a ball is not found.
        InputError: The points do not determine a camera.
    """
    case, rod = workcell.case, calibrating_rod(workcell.case, workcell)
    points = grid_points(case)
    q_command, branch = configurations(rod, points, checker)
    for number, (start, end) in enumerate(pairwise(q_command), start=2):
        contact = path_contact(checker, np.stack([start, end]))
        if contact is not None:
            what = f"calibration: {contact.body} would touch {contact.other} on the way to point {number}"
            raise NoAnswerError(what, code="motion_touches")
    sigma, q_true = case.truth_errors.measuring_mm, q_command[0]
    measured, detections, stood = [], [], []
    for number, q in enumerate(q_command, start=1):
        q_true = workcell.arm.settle(q, q_true, rng)
        stood.append(q_true)
        ball = LocatedPair(
            workcell.ball_c(q_true), case.file.tool.ball_diameter_mm / 2, workcell.rod_c(q_true), head_there=False
        )
        measured.append(ball.center_c + rng.normal(0.0, sigma, 3))
        searches = tuple(Search(camera, measured[-1], FIRST_SEARCH_PX) for camera in planned_cameras(case))
        seen = look_at(detector, ball, searches, case.file.servo.frames)
        if isinstance(seen, Lost):
            raise NoAnswerError(f"calibration, point {number}: {seen.reason}", code="ball_not_found")
        detections.append(seen)
    measured_c = np.array(measured)
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
        np.array(stood),
        branch,
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
