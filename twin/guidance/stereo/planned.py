"""The stereo workcell as its case plans it: cameras, frames, rod and contacts; what is true of it only the plant knows.

Two frames matter: the base's, in which the arm is commanded, and C, which the measuring arm defines at the calibration
and in which the cameras are known. How C lies in the base only a calibration tells.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.geometry.rigid import frame_yz, pose
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera, stereo_pair
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase, ToolSection
from puncture_twin.twin.guidance.stereo.servo_law import CarriedRod, rod_orientation

GRID = (3, 2, 2)
"""Points of the calibration along the base's x, y and z."""


def planned_cameras(case: ServoCase) -> tuple[Camera, ...]:
    """The cameras as the case plans them; only a calibration tells where they are."""
    plan = case.file.cameras
    return stereo_pair(*plan.size_px, plan.focal_px, plan.baseline_mm, plan.distance_mm, plan.distortion)


def calibration_frame(case: ServoCase) -> Floats:
    """T_base_c, shape (4, 4), mm: C at the calibrated volume's middle, z along the cameras' view, y down.

    The cameras stand on the far side of the head, seen from the arm, and look back and down at it.
    """
    down = np.radians(case.file.cameras.elevation_deg)
    z, y = np.array([-np.cos(down), 0.0, -np.sin(down)]), np.array([np.sin(down), 0.0, -np.cos(down)])
    return pose(frame_yz(y, z), case.file.calibration.center_mm)


def head_pose(case: ServoCase) -> Floats:
    """T_base_m, shape (4, 4), mm: the head's z up, its face (-y) along the base's x at yaw 0."""
    head = case.file.head
    return pose(Rotation.from_euler("z", 90.0 + head.yaw_deg, degrees=True).as_matrix(), head.position_mm)


def rod_tool(tool: ToolSection) -> Tool:
    """Rod and holder for the collision checker; the rod as thick as its ball, and up to the ball's far side."""
    length = tool.rod_mm + tool.ball_diameter_mm / 2
    return Tool(length, length - tool.holder_mm, tool.ball_diameter_mm, tool.holder_diameter_mm)


def workcell_checker(case: ServoCase, T_base_m: Floats | None) -> FastChecker:
    """The planner's collision checker of the workcell.

    Args:
        T_base_m: Where the head is believed to stand, shape (4, 4), mm; None for a workcell without it.
    """
    boxes = []
    for box in case.file.box:
        boxes.append(Box(box.name, pose(np.eye(3), box.center_mm), box.size_mm))
    skin = None if T_base_m is None else case.skin.transformed(T_base_m)
    model, padding = case.model, case.file.servo.padding_mm
    return FastChecker(model, rod_tool(case.file.tool), boxes, skin, padding_mm=padding)


def carried_rod(case: ServoCase) -> CarriedRod:
    """The nominal arm with the case's rod, in the orientation of the targets."""
    tool = case.file.tool
    return CarriedRod(case.model, tool.rod_mm, rod_orientation(float(np.radians(tool.tilt_deg))))


def calibrating_rod(case: ServoCase) -> CarriedRod:
    """The nominal arm with the case's rod, in the orientation of the calibration."""
    tilt = case.file.calibration.tilt_deg
    rod = carried_rod(case)
    return rod if tilt is None else rod._replace(R_base_flange=rod_orientation(float(np.radians(tilt))))


def grid_points(case: ServoCase) -> Floats:
    """The calibration's points, base frame, shape (12, 3), mm: neighbours in the order of the arm's path."""
    cal = case.file.calibration
    steps = np.array(list(product(*(np.linspace(-0.5, 0.5, count) for count in GRID))))
    return np.asarray(cal.center_mm + steps * cal.size_mm)
