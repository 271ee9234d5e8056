"""A self-calibration in the twin: recorded, calibrated, held against what is true; then punctures of seen targets."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Pixels, rms
from puncture_twin.planning.base.progress import Stages, Watcher
from puncture_twin.twin.guidance.ultrasound.acquisition import Acquisition, ProbeDevices, acquire
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.needle_detector import Detection
from puncture_twin.twin.guidance.ultrasound.pose_choice import (
    CandidatePoses,
    TwoArms,
    aim,
    expected_error_mm,
    predicted_tre,
    recorded_pose,
)
from puncture_twin.twin.guidance.ultrasound.recording_file import calibrate_case
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase
from puncture_twin.twin.plant.bmode_image import Lesion, NeedleInImage, render
from puncture_twin.twin.plant.ultrasound_workcell import ShownNeedle, UltrasoundPlant, WorkcellTruth, draw_workcell

TARGETS = 6
"""Punctures per seed."""
UNSEEN = 60
"""Candidates per seed at which prediction and truth are compared."""
LESION_MM = 4.0
"""Radius of the lesion that is drawn about the target in an image."""


class Puncture(NamedTuple):
    """Prediction and ground truth of one puncture."""

    candidate: int
    target_image: Floats  # true target in the true image, shape (3,), mm; it lies in the plane, for it is seen
    needle: NeedleInImage  # in the true image
    predicted_mm: float  # error (rms) of calibration and arms
    click_mm: float  # the reading's deviation per axis of the image

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
    case: SelfcalCase, workcell: TwoArms, candidates: CandidatePoses, rows: NDArray[np.int_], truth: WorkcellTruth,
    calibration: Calibration, rng: np.random.Generator,
) -> tuple[Puncture, ...]:  # fmt: skip
    """Send the needle to the middle of the image's tip, at one held-out candidate after the other."""
    models, click_mm, reached = case.models, case.content.truth.click_mm, []
    for row in rows.tolist():
        q_probe = candidates.q_probe[row]
        rest_probe = truth.probe_arm.settle(q_probe, q_probe, rng)
        target = np.array([*candidates.poses.P[row], 0.0])
        clicked = target[:2] + rng.normal(0.0, click_mm, 2)
        q_needle = aim(candidates, row, clicked, calibration, models)
        if np.isnan(q_needle).any() or workcell.verdict(q_probe, q_needle) is not None:
            continue
        rest_needle = truth.needle_arm.settle(q_needle, q_needle, rng)
        predicted = expected_error_mm(calibration, recorded_pose(models, q_probe, q_needle, clicked))
        reached.append(Puncture(row, target, truth.needle_in_image(rest_probe, rest_needle), predicted, click_mm))
    return tuple(reached)


def unseen_errors_mm(
    candidates: CandidatePoses, rows: NDArray[np.int_], truth: WorkcellTruth, calibration: Calibration,
    rng: np.random.Generator,
) -> Floats:  # fmt: skip
    """Predicted minus true tip at candidates that were not recorded, in the image; shape (n,), mm.

    Both arms stand where nominal kinematics put them, and their errors that were found are counted; the
    image's are not in it.
    """
    errors, models = [], (truth.probe_arm.nominal, truth.needle_arm.nominal)
    for row in rows:
        q_probe, q_needle = candidates.q_probe[row], candidates.q_needle[row]
        rest_probe = truth.probe_arm.settle(q_probe, q_probe, rng)
        seen = truth.needle_in_image(rest_probe, truth.needle_arm.settle(q_needle, q_needle, rng)).tip_image
        recorded = recorded_pose(models, q_probe, q_needle, seen)
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


@dataclass(frozen=True, eq=False)
class SelfcalTrial:
    """One seed in the twin; `unseen_mm` (k,) is predicted minus true tip at poses that were not recorded."""

    seed: int
    truth: WorkcellTruth
    acquisition: Acquisition
    shown: tuple[ShownNeedle, ...]
    calibration: Calibration
    unseen_mm: Floats
    punctures: tuple[Puncture, ...]

    def detection_errors(self) -> Floats:
        """Detected minus true tip, along and across the true shaft, mm, and the angle's error, rad; shape (n, 3)."""
        rows = []
        for shot in self.acquisition.shots:
            assert isinstance(shot.found, Detection)  # only those are kept as shots
            needle, v = self.shown[shot.number].needle, shot.found.direction_image
            d = needle.direction_image[:2] / np.linalg.norm(needle.direction_image[:2])
            e = shot.found.tip_image - needle.tip_image[:2]
            rows.append([e @ d, d[0] * e[1] - d[1] * e[0], np.arctan2(d[0] * v[1] - d[1] * v[0], d @ v)])
        return np.array(rows, dtype=np.float64)


def run_trial(
    case: SelfcalCase, workcell: TwoArms, candidates: CandidatePoses, seed: int, stages: Stages, watcher: Watcher
) -> SelfcalTrial:
    """Record, calibrate and puncture in a workcell drawn from a seed."""
    rng = np.random.default_rng(seed)
    truth = draw_workcell(case, rng)
    plant = UltrasoundPlant(case, truth, rng)
    devices = ProbeDevices(plant.probe_arm, plant.needle_arm, plant, plant)
    with stages.time("recording"):
        taken = acquire(case, workcell, candidates, devices, rng,
                        lambda done, total: watcher.count(f"seed {seed}: pictures", done, total))  # fmt: skip
    with stages.time("calibrate"):
        calibration = calibrate_case(taken.recording, case)
    others = rng.permutation(taken.left)
    with stages.time("puncture"):
        unseen = unseen_errors_mm(candidates, others[:UNSEEN], truth, calibration, rng)
        reached = punctures(case, workcell, candidates, others[:TARGETS], truth, calibration, rng)
    return SelfcalTrial(seed, truth, taken, tuple(plant.shown), calibration, unseen, reached)


def trial_summary(trial: SelfcalTrial) -> dict[str, Any]:
    """One seed as plain values, mm and degrees."""
    calibration, truth, errors = trial.calibration, trial.truth, trial.detection_errors()
    a, b = calibration.needle_direction_end2, truth.V
    angle = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
    return {
        "seed": trial.seed,
        "residual_rms_mm": calibration.rms_mm,
        "predicted_tre_mm": predicted_tre(calibration, trial.acquisition.recording),
        "held_out_error_rms_mm": rms(trial.unseen_mm),
        "X_error_mm": float(np.linalg.norm(calibration.X[:3, 3] - truth.X[:3, 3])),
        "Y_error_mm": float(np.linalg.norm(calibration.Y[:3, 3] - truth.Y[:3, 3])),
        "tip_error_mm": float(np.linalg.norm(calibration.tip_end2 - truth.tip_end2)),
        "needle_direction_error_deg": float(np.degrees(angle)),
        "detected_tip_along_mm": [float(np.mean(errors[:, 0])), float(np.std(errors[:, 0]))],
        "detected_tip_across_mm": [float(np.mean(errors[:, 1])), float(np.std(errors[:, 1]))],
        "detected_angle_deg": np.degrees([np.mean(errors[:, 2]), np.std(errors[:, 2])]).tolist(),
        "missed": trial.acquisition.missed,
        "set_aside": list(calibration.outliers),
        "true_contacts": sum(one.touched for one in trial.shown),
        "punctures": puncture_summary(trial.punctures),
    }


def puncture_summary(reached: tuple[Puncture, ...]) -> dict[str, Any] | None:
    """Errors at the targets, mm; None without any."""
    if not reached:
        return None
    names = ("error_mm", "lateral_mm", "depth_mm", "predicted_mm", "expected_mm")
    errors, lateral, depth, predicted, expected = ([getattr(one, name) for one in reached] for name in names)
    return {
        "targets": len(reached),
        "error_rms_mm": rms(errors),
        "error_median_mm": float(np.median(errors)),
        "error_worst_mm": max(errors),
        "lateral_rms_mm": rms(lateral),
        "depth_mean_mm": float(np.mean(depth)),
        "depth_rms_mm": rms(depth),
        "predicted_rms_mm": rms(predicted),
        "predicted_with_reading_rms_mm": rms(expected),
    }
