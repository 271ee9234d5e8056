"""Punctures after the calibration: the needle sent to a target seen in the image, and the ground truth of its tip."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats, Pixels
from puncture_twin.twin.guidance.ultrasound.acquisition import WorkcellTruth, nearest_configuration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.image.probe_image import Lesion, NeedleInImage, render
from puncture_twin.twin.guidance.ultrasound.pose_choice import CandidatePoses, needle_flange
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase
from puncture_twin.twin.guidance.ultrasound.two_arms import TwoArms

AIM_STEPS = 3
"""Iterations of the command that counts the needle arm's errors: each leaves a thousandth of what was left before."""

LESION_MM = 4.0
"""Radius of the lesion that is drawn about the target in an image."""


class Puncture(NamedTuple):
    """Prediction and ground truth of one puncture."""

    candidate: int
    target_image: Floats
    """True target in the true image, shape (3,), mm; it lies in the plane, for it is seen."""
    needle: NeedleInImage
    """The true needle at its end, in the true image."""
    predicted_mm: float
    """Expected (rms) error from the calibration and the arms."""
    click_mm: float
    """Standard deviation of the reading, per axis of the image."""

    @property
    def error_image(self) -> Floats:
        """True tip minus true target, shape (3,), mm."""
        return self.needle.tip_image - self.target_image

    @property
    def error_mm(self) -> float:
        """Distance of the true tip from the true target."""
        return float(np.linalg.norm(self.error_image))

    @property
    def expected_mm(self) -> float:
        """Expected (rms) error from calibration, arms and the reading of the target."""
        return float(np.sqrt(self.predicted_mm**2 + 2.0 * self.click_mm**2))

    @property
    def depth_mm(self) -> float:
        """Error along the true needle, mm: + is too deep."""
        return float(self.error_image @ self.needle.direction_image)

    @property
    def lateral_mm(self) -> float:
        """Error across the needle, mm."""
        return float(np.sqrt(max(self.error_mm**2 - self.depth_mm**2, 0.0)))


def punctures(
    case: SelfcalCase,
    workcell: TwoArms,
    candidates: CandidatePoses,
    rows: NDArray[np.int_],
    truth: WorkcellTruth,
    calibration: Calibration,
    rng: np.random.Generator,
) -> tuple[Puncture, ...]:
    """Send the needle to the middle of the image's tip, one held-out candidate after the other.

    Args:
        case: The self-calibration case.
        workcell: Its collision checker; a target at which something would touch is passed over.
        candidates: Where probe and needle can stand.
        rows: The candidates to use: none of them was recorded.
        truth: The ground truth.
        calibration: What was found.
        rng: The reading of the target and the arms' repeatability.
    """
    done = [_puncture(case, workcell, candidates, int(row), truth, calibration, rng) for row in rows]
    return tuple(one for one in done if one is not None)


def _puncture(
    case: SelfcalCase,
    workcell: TwoArms,
    candidates: CandidatePoses,
    row: int,
    truth: WorkcellTruth,
    calibration: Calibration,
    rng: np.random.Generator,
) -> Puncture | None:
    q_probe = candidates.q_probe[row]
    rest_probe = truth.probe_arm.settle(q_probe, q_probe, rng)
    target = np.array([*candidates.poses.P[row], 0.0])
    clicked = target[:2] + rng.normal(0.0, case.content.truth.click_mm, 2)
    q_needle = aim(candidates, row, clicked, calibration, truth)
    if np.isnan(q_needle).any() or workcell.verdict(q_probe, q_needle) is not None:
        return None
    rest_needle = truth.needle_arm.settle(q_needle, q_needle, rng)
    predicted = expected_error_mm(calibration, _recorded_pose(truth, q_probe, q_needle, clicked))
    ended = truth.needle_in_image(rest_probe, rest_needle)
    return Puncture(row, target, ended, predicted, case.content.truth.click_mm)


def aim(
    candidates: CandidatePoses, row: int, target_mm: Floats, calibration: Calibration, truth: WorkcellTruth
) -> Floats:
    """Commanded joints of the needle's arm by its nominal kinematics and the calibration: (6,), rad; NaN out of reach.

    Args:
        candidates: Where probe and needle can stand.
        row: The candidate whose probe pose, insertion and roll are used.
        target_mm: In the image, shape (2,).
        calibration: What was found.
        truth: Only for the nominal model of its needle arm.
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
        q = nearest_configuration(truth.needle_arm, command, q)
        if calibration.arms is None or np.isnan(q).any():
            break
        recorded = _recorded_pose(truth, candidates.q_probe[row], q, target_mm)
        command = recorded.B[0] @ np.linalg.inv(calibration.corrected(recorded)[1][0]) @ goal
    return q


def expected_error_mm(calibration: Calibration, poses: Recording) -> float:
    """Expected (rms) distance of the tip from where the image has it, over poses with joints."""
    return float(np.sqrt(np.mean(np.trace(calibration.tip_covariances(poses), axis1=1, axis2=2))))


def _recorded_pose(truth: WorkcellTruth, q_probe: Floats, q_needle: Floats, tip_mm: Floats) -> Recording:
    """One pose as both controllers print it, with the tip at a point of the image."""
    A, B = flange_pose(truth.probe_arm.nominal, q_probe), flange_pose(truth.needle_arm.nominal, q_needle)
    return Recording(A[None], B[None], tip_mm[None, :2], q_probe=q_probe[None], q_needle=q_needle[None])


def unseen_errors_mm(
    candidates: CandidatePoses,
    rows: NDArray[np.int_],
    truth: WorkcellTruth,
    calibration: Calibration,
    rng: np.random.Generator,
) -> Floats:
    """Predicted minus true tip at candidates that were not recorded, in the image; shape (n,), mm.

    Both arms stand where nominal kinematics put them, and their errors that were found are counted; the
    image's are not in it.
    """
    errors = []
    for row in rows:
        rests = [
            arm.settle(q, q, rng)
            for arm, q in (
                (truth.probe_arm, candidates.q_probe[row]),
                (truth.needle_arm, candidates.q_needle[row]),
            )
        ]
        seen = truth.needle_in_image(*rests).tip_image
        recorded = _recorded_pose(truth, candidates.q_probe[row], candidates.q_needle[row], seen)
        A, B = calibration.corrected(recorded)
        T_base1_image, T_base1_end2 = A[0] @ calibration.X, calibration.Y @ B[0]
        tip = T_base1_end2[:3, :3] @ calibration.tip_end2 + T_base1_end2[:3, 3]
        predicted = np.linalg.inv(T_base1_image) @ np.append(tip, 1.0)
        errors.append(float(np.linalg.norm(predicted[:3] - seen)))
    return np.array(errors)


def puncture_image(case: SelfcalCase, puncture: Puncture, rng: np.random.Generator) -> Pixels:
    """The image after the puncture: a lesion about the target, and the needle."""
    lesion = Lesion(puncture.target_image, LESION_MM)
    return render(case.content.image.imager(), puncture.needle, rng, echo=case.content.image.echo(), lesion=lesion)
