"""Calibrations, trials and punctures as plain values, mm and degrees: for files, JSON, page and terminal."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.puncture import expected_error_mm


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
    known = rms(found.predicted_tre_mm(recording.P, recording.A)) if found.arms is None else None
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


def rms(values: Floats) -> float:
    """Root mean square of any shape; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")
