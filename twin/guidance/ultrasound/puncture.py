"""Aim at a target that is seen in the image, by the calibration and the arms' nominal kinematics."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, rms
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.pose_choice import CandidatePoses, needle_flange

AIM_STEPS = 3
"""Iterations of the command that counts the needle arm's errors: each leaves a thousandth of what was left before."""


def aim(
    candidates: CandidatePoses, row: int, target_mm: Floats, calibration: Calibration, models: tuple[UrModel, UrModel]
) -> Floats:
    """Commanded joints of the needle's arm by its nominal kinematics and the calibration: (6,), rad; NaN out of reach.

    Args:
        row: The candidate whose probe pose, insertion and roll are used.
        target_mm: In the image, shape (2,).
        models: The probe's and the needle's arm, as they are drawn.
    """
    poses = candidates.poses
    assert poses.v is not None  # candidates are made with directions
    q = candidates.q_needle[row]
    A, _ = calibration.corrected(poses.subset(slice(row, row + 1)))
    T_base2_image = np.linalg.inv(calibration.Y) @ A[0] @ calibration.X
    tip, along = np.array([[*target_mm, 0.0]]), np.array([[*poses.v[row], 0.0]])
    roll = candidates.roll[row : row + 1]
    V, Q = calibration.needle_direction_end2, calibration.tip_end2
    goal = needle_flange(T_base2_image[None], tip, along, roll, Q, V)[0]
    command = goal
    for _ in range(AIM_STEPS):
        q = nearest_configuration(models[1], command, q)
        if calibration.arms is None or np.isnan(q).any():
            break
        recorded = recorded_pose(models, candidates.q_probe[row], q, target_mm)
        command = recorded.B[0] @ np.linalg.inv(calibration.corrected(recorded)[1][0]) @ goal
    return q


def expected_error_mm(calibration: Calibration, poses: Recording) -> float:
    """Expected (rms) distance of the tip from where the image has it, over poses with joints."""
    return float(np.sqrt(np.mean(np.trace(calibration.tip_covariances(poses), axis1=1, axis2=2))))


def predicted_tre(found: Calibration, recording: Recording) -> float:
    """Expected (rms) error at the recorded tips, mm: from the calibration, the declared arms, an image that errs."""
    known = rms(found.predicted_tre_mm(recording.P, recording.A)) if found.arms is None else None
    image_mm = found.image.rms_mm if found.image is not None and found.image.significant else 0.0
    return float(np.hypot(expected_error_mm(found, recording) if known is None else known, image_mm))


def recorded_pose(models: tuple[UrModel, UrModel], q_probe: Floats, q_needle: Floats, tip_mm: Floats) -> Recording:
    """One pose as both controllers print it, with the tip at a point of the image."""
    A, B = flange_pose(models[0], q_probe), flange_pose(models[1], q_needle)
    return Recording(A[None], B[None], tip_mm[None, :2], q_probe=q_probe[None], q_needle=q_needle[None])


def nearest_configuration(model: UrModel, T_base_flange: Floats, q_near: Floats) -> Floats:
    """The nominal arm's configuration for a flange pose that is nearest to another, shape (6,), rad; NaN for none."""
    q = nearest_within_limits(model, inverse(model, T_base_flange)[0], q_near)
    away = np.linalg.norm(q - q_near, axis=1)
    return np.array(q[int(np.argmin(np.where(np.isnan(away), np.inf, away)))])
