"""What ``selfcal`` prints for a person."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.summaries import (
    noise_summary,
    predicted_tre,
    puncture_summary,
    trial_summary,
)
from puncture_twin.twin.jobs.selfcal.selfcal import SelfcalRun

REASON_WORDS = MappingProxyType(
    {
        "ok": "can be taken",
        "tip_outside_phantom": "tip outside the phantom",
        "probe_out_of_reach": "probe arm cannot reach",
        "needle_out_of_reach": "needle arm cannot reach",
        "probe_arm_collision": "probe arm would touch itself, the table or the phantom",
        "needle_arm_collision": "needle arm would touch itself, the table or, with more than the needle, the phantom",
        "arms_collide": "the arms, or probe and needle, would touch",
    }
)
"""Of the reasons for which a drawn pose is not taken."""

NOISE_WORDS = MappingProxyType(
    {
        "robot_mm": "stated noise of each flange, mm per axis",
        "robot_deg": "stated noise of each flange, ° per axis",
        "image_mm": "stated noise of the tip in the image, mm per axis",
        "direction_deg": "noise of the direction in the image, °",
        "inside_image_mm": "spread of the residuals in the image, mm per axis",
        "across_image_mm": "spread of the residuals across the slice, mm",
    }
)


def deviations(found: Calibration) -> dict[str, float]:
    """Standard deviation of every parameter, by name; rotations in degrees."""
    sigma = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
    pairs = zip(found.parameters, sigma, strict=True)
    return {
        name.replace("_rad", "_deg"): float(np.degrees(value) if name.endswith("_rad") else value)
        for name, value in pairs
    }


def selfcal_text(run: SelfcalRun) -> str:
    """Poses, calibration, what it cannot show, punctures; then the files."""
    lines = [*_poses(run), *_calibration(run), *_trials(run), *_punctures(run)]
    lines += [f"warning: {warning}" for warning in run.warnings]
    stages = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in run.stages.seconds.items())
    return "\n".join([*lines, f"seconds: {stages}", "look at:", *(f"  {path}" for path in run.files)])


def _poses(run: SelfcalRun) -> list[str]:
    if run.candidates is None or run.choice is None:
        return [f"recording {run.name}: {len(run.recording)} poses"]
    counts = run.candidates.counts
    lines = [f"case {run.name}: {sum(counts.values())} poses drawn in the common workspace"]
    lines += [f"  {count:5d}  {REASON_WORDS[reason]}" for reason, count in counts.items() if count]
    choice = run.choice
    lines.append(
        f"{len(run.recording)} recorded; expected error (Cramer-Rao, with the usual noise) {choice.chosen_mm:.3f} mm; "
        f"random choices of as many: median {choice.median_random_mm:.3f}, best {min(choice.random_mm):.3f} mm"
    )
    return lines


def _calibration(run: SelfcalRun) -> list[str]:
    found = run.calibration
    noise = ", ".join(f"{NOISE_WORDS[key]} {value:.3f}" for key, value in noise_summary(found).items())
    lines = [
        f"calibration: residuals {found.rms_mm:.3f} mm rms, {found.iterations} iterations, "
        f"condition {found.condition:.1e}",
        f"  {noise}",
        f"  expected error at the tip (rms, calibration alone) {predicted_tre(found, run.recording):.3f} mm",
        f"  tip in the flange's frame ({', '.join(f'{x:.2f}' for x in found.tip_end2)}) mm",
    ]
    if found.outliers:
        lines.append(f"  set aside: {', '.join(found.outliers)}")
    return lines + [f"  cannot be shown: {line}" for line in found.cannot_show]


def _trials(run: SelfcalRun) -> list[str]:
    lines = []
    for trial in run.trials:
        values = trial_summary(trial)
        missed = "; ".join(f"{count} {reason}" for reason, count in values["missed"].items()) or "none"
        along = values["detected_tip_along_mm"]
        lines.append(
            f"seed {trial.seed}: residuals {values['residual_rms_mm']:.3f} mm, held-out tip error "
            f"{values['held_out_error_rms_mm']:.3f} mm rms (expected {values['predicted_tre_mm']:.3f} + arms); "
            f"detected tip {along[0]:+.2f} mm along the shaft, sd {along[1]:.2f}; not used: {missed}; "
            f"true contacts of the arms: {values['true_contacts']}"
        )
    return lines


def _punctures(run: SelfcalRun) -> list[str]:
    reached = puncture_summary(run.punctures)
    if reached is None:
        return ["no target could be reached without touching"] if run.trials else []
    return [
        f"punctures: {reached['targets']} targets over {len(run.trials)} seeds: the true tip ended "
        f"{reached['error_rms_mm']:.2f} mm (rms) from the true target, worst {reached['error_worst_mm']:.2f} mm",
        f"  lateral {reached['lateral_rms_mm']:.2f} mm rms; depth {reached['depth_mean_mm']:+.2f} mm on average "
        f"(+ is too deep), {reached['depth_rms_mm']:.2f} mm rms",
        f"  expected: {reached['predicted_rms_mm']:.2f} mm from the calibration, "
        f"{reached['predicted_with_reading_rms_mm']:.2f} mm with the reading of the target, and the arms on top",
    ]
