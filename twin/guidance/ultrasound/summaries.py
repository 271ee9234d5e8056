"""Calibrations, trials and punctures as plain values, mm and degrees: for files, JSON, page and terminal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.ultrasound.acquisition import Acquisition, WorkcellTruth
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.puncture import Puncture, expected_error_mm


@dataclass(frozen=True, eq=False)
class SelfcalTrial:
    """One seed in the twin: workcell, recording, calibration, and the errors at targets.

    Attributes:
        seed: Of this trial.
        truth: The ground truth.
        acquisition: What was recorded.
        calibration: What was found.
        unseen_mm: Predicted minus true tip at poses that were not recorded, shape (k,).
        punctures: One per target.
    """

    seed: int
    truth: WorkcellTruth
    acquisition: Acquisition
    calibration: Calibration
    unseen_mm: Floats
    punctures: tuple[Puncture, ...]


@dataclass(frozen=True)
class Choice:
    """Gain by choosing poses, as the Cramer-Rao bound over all candidates, mm."""

    chosen_mm: float
    random_mm: tuple[float, ...]
    """Bounds of random choices of as many poses."""

    @property
    def median_random_mm(self) -> float:
        """Median of the random ones."""
        return float(np.median(self.random_mm))


def calibration_summary(found: Calibration, recording: Recording) -> dict[str, Any]:
    """A calibration's main values, mm and degrees."""
    return {
        "T_end1_image": found.X.tolist(),
        "T_base1_base2": found.Y.tolist(),
        "tip_end2_mm": found.tip_end2.tolist(),
        "needle_direction_end2": found.needle_direction_end2.tolist(),
        "scale_mm": found.scale.tolist() if recording.pixels else None,
        "poses": len(recording),
        "residual_rms_mm": found.rms_mm,
        "set_aside": list(found.outliers),
        "findings": [one.document() for one in found.findings],
        "iterations": found.iterations,
        "condition": found.condition,
        "noise": noise_summary(found),
        "predicted_tre_mm": predicted_tre(found, recording),
        "tip_bias_mm": found.tip_bias_mm,
        "arms": arms_summary(found),
        "cannot_show": list(found.cannot_show),
    }


def noise_summary(found: Calibration) -> dict[str, float]:
    """The stated noise, or the estimated spread."""
    if isinstance(found.noise, Noise):
        stated = found.noise
        return {
            "robot_mm": stated.robot_mm,
            "robot_deg": float(np.degrees(stated.robot_rad)),
            "image_mm": stated.image_mm,
            "direction_deg": float(np.degrees(stated.direction_rad)),
            "off_plane_mm": stated.off_plane_mm,
        }
    spread = found.noise
    return {
        "inside_image_mm": spread.inside_mm,
        "across_image_mm": spread.across_mm,
        "direction_deg": float(np.degrees(spread.direction_rad)),
    }


def arms_summary(found: Calibration) -> dict[str, Any] | None:
    """Estimated errors of the declared arms, and whether the residuals agree; None where none were declared."""
    if found.arms is None:
        return None
    return {
        "found_sd": found.arm_errors.tolist(),
        "chi2_per_freedom": found.chi_squared_ratio,
        "chi2_chance": found.chi_squared_chance(),
    }


def predicted_tre(found: Calibration, recording: Recording) -> float:
    """Expected (rms) error at the recorded tips, mm: from the calibration, the declared arms, an image that errs."""
    known = _rms(found.predicted_tre_mm(recording.P, recording.A)) if found.arms is None else None
    image_mm = found.image.rms_mm if found.image is not None and found.image.significant else 0.0
    return float(np.hypot(expected_error_mm(found, recording) if known is None else known, image_mm))


def choice_summary(choice: Choice) -> dict[str, Any]:
    """The bounds of a choice, mm."""
    return {
        "chosen_bound_mm": choice.chosen_mm,
        "random_bound_median_mm": choice.median_random_mm,
        "random_bound_best_mm": min(choice.random_mm),
        "random_sets": len(choice.random_mm),
    }


def trial_summary(trial: SelfcalTrial) -> dict[str, Any]:
    """One seed as plain values, mm and degrees."""
    found, truth, errors = trial.calibration, trial.truth, trial.acquisition.detection_errors()
    return {
        "seed": trial.seed,
        "residual_rms_mm": found.rms_mm,
        "predicted_tre_mm": predicted_tre(found, trial.acquisition.recording),
        "held_out_error_rms_mm": _rms(trial.unseen_mm),
        "X_error_mm": float(np.linalg.norm(found.X[:3, 3] - truth.X[:3, 3])),
        "Y_error_mm": float(np.linalg.norm(found.Y[:3, 3] - truth.Y[:3, 3])),
        "tip_error_mm": float(np.linalg.norm(found.tip_end2 - truth.tip_end2)),
        "needle_direction_error_deg": _angle_deg(found.needle_direction_end2, truth.V),
        "detected_tip_along_mm": [float(np.mean(errors[:, 0])), float(np.std(errors[:, 0]))],
        "detected_tip_across_mm": [float(np.mean(errors[:, 1])), float(np.std(errors[:, 1]))],
        "detected_angle_deg": np.degrees([np.mean(errors[:, 2]), np.std(errors[:, 2])]).tolist(),
        "missed": trial.acquisition.missed,
        "set_aside": list(found.outliers),
        "true_contacts": sum(shot.touched for shot in (*trial.acquisition.shots, *trial.acquisition.missed_shots)),
        "punctures": puncture_summary(trial.punctures),
    }


def puncture_summary(reached: tuple[Puncture, ...]) -> dict[str, Any] | None:
    """Errors at the targets, mm; None without any."""
    if not reached:
        return None
    errors = np.array([one.error_mm for one in reached])
    return {
        "targets": len(reached),
        "error_rms_mm": _rms(errors),
        "error_median_mm": float(np.median(errors)),
        "error_worst_mm": float(errors.max()),
        "lateral_rms_mm": _rms(np.array([one.lateral_mm for one in reached])),
        "depth_mean_mm": float(np.mean([one.depth_mm for one in reached])),
        "depth_rms_mm": _rms(np.array([one.depth_mm for one in reached])),
        "predicted_rms_mm": _rms(np.array([one.predicted_mm for one in reached])),
        "predicted_with_reading_rms_mm": _rms(np.array([one.expected_mm for one in reached])),
    }


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def _angle_deg(a: Floats, b: Floats) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
