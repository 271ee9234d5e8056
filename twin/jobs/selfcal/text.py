"""What ``selfcal`` found, as one table of plain values (``--json`` and the page read nothing else), and as text."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.twin.guidance.ultrasound.summaries import (
    calibration_summary,
    choice_summary,
    puncture_summary,
    trial_summary,
)
from puncture_twin.twin.jobs.selfcal.selfcal import SelfcalRun

Facts = Mapping[str, Any]
"""What `selfcal_facts` returns: mm and degrees."""


def selfcal_facts(run: SelfcalRun) -> dict[str, Any]:
    """Poses, calibration, trials, punctures, and what was written."""
    return {
        **calibration_summary(run.calibration, run.recording),
        "name": run.name,
        "inputs": inputs_document(run.inputs),
        "candidates": None if run.candidates is None else run.candidates.counts,
        "choice": None if run.choice is None else choice_summary(run.choice),
        "trials": [trial_summary(trial) for trial in run.trials],
        "punctures": puncture_summary(run.punctures),
        "seconds": {stage: round(seconds, 3) for stage, seconds in run.stages.seconds.items()},
        "files": [str(path) for path in run.files],
        "warnings": list(run.warnings),
    }


REASON_TEXT = MappingProxyType(
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

NOISE_TEXT = MappingProxyType(
    {
        "robot_mm": "stated noise of each flange, mm per axis",
        "robot_deg": "stated noise of each flange, ° per axis",
        "image_mm": "stated noise of the tip in the image, mm per axis",
        "off_plane_mm": "stated deviation of the tip from the slice, mm",
        "direction_deg": "noise of the direction in the image, °",
        "inside_image_mm": "spread of the residuals in the image, mm per axis",
        "across_image_mm": "spread of the residuals across the slice, mm",
    }
)


def selfcal_text(facts: Facts) -> str:
    """Poses, calibration, what it cannot show, punctures; then the files."""
    lines = [*_poses(facts), *_calibration(facts), *map(_trial, facts["trials"]), *_punctures(facts)]
    lines += [f"warning: {warning}" for warning in facts["warnings"]]
    stages = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in facts["seconds"].items())
    return "\n".join([*lines, f"seconds: {stages}", "look at:", *(f"  {path}" for path in facts["files"])])


def _poses(facts: Facts) -> list[str]:
    counts, choice = facts["candidates"], facts["choice"]
    if counts is None or choice is None:
        return [f"recording {facts['name']}: {facts['poses']} poses"]
    lines = [f"case {facts['name']}: {sum(counts.values())} poses drawn in the common workspace"]
    lines += [f"  {count:5d}  {REASON_TEXT[reason]}" for reason, count in counts.items() if count]
    lines.append(
        f"{facts['poses']} recorded; expected error (Cramer-Rao, with the usual noise) "
        "{chosen_bound_mm:.3f} mm; random choices of as many: median {random_bound_median_mm:.3f}, best "
        "{random_bound_best_mm:.3f} mm".format(**choice)
    )
    return lines


def _calibration(facts: Facts) -> list[str]:
    noise = ", ".join(f"{NOISE_TEXT[key]} {value:.3f}" for key, value in facts["noise"].items())
    lines = [
        "calibration: residuals {residual_rms_mm:.3f} mm rms, {iterations} iterations, "
        "condition {condition:.1e}".format(**facts),
        f"  {noise}",
        f"  expected tip error (rms, {counted(facts)}) {facts['predicted_tre_mm']:.3f} mm",
        f"  tip in the flange's frame ({', '.join(f'{x:.2f}' for x in facts['tip_end2_mm'])}) mm",
    ]
    if facts["arms"] is not None:
        lines.append("  chi-squared over freedom {chi2_per_freedom:.2f}".format(**facts["arms"]))
    if facts["set_aside"]:
        lines.append(f"  set aside: {', '.join(facts['set_aside'])}")
    lines += [f"  note: {one['sentence']}" for one in facts["findings"] if one["severity"] == "note"]
    return lines + [f"  cannot be shown: {line}" for line in facts["cannot_show"]]


def counted(facts: Facts) -> str:
    """What the expected error holds."""
    return "noise alone" if facts["arms"] is None else "noise and the arms' declared errors"


def missed_text(trial: Facts) -> str:
    """How many poses of a trial were not used, by reason."""
    return "; ".join(f"{count} {reason}" for reason, count in trial["missed"].items()) or "none"


def _trial(trial: Facts) -> str:
    along, spread = trial["detected_tip_along_mm"]
    return (
        "seed {seed}: residuals {residual_rms_mm:.3f} mm, held-out tip error {held_out_error_rms_mm:.3f} mm rms "
        "(expected {predicted_tre_mm:.3f}); ".format(**trial)
        + f"detected tip {along:+.2f} mm along the shaft, sd {spread:.2f}; not used: {missed_text(trial)}; "
        f"true contacts of the arms: {trial['true_contacts']}"
    )


def _punctures(facts: Facts) -> list[str]:
    reached = facts["punctures"]
    if reached is None:
        return ["no target could be reached without touching"] if facts["trials"] else []
    return [
        f"punctures: {reached['targets']} targets over {len(facts['trials'])} seeds: the true tip ended "
        f"{reached['error_rms_mm']:.2f} mm (rms) from the true target, worst {reached['error_worst_mm']:.2f} mm",
        f"  lateral {reached['lateral_rms_mm']:.2f} mm rms; depth {reached['depth_mean_mm']:+.2f} mm on average "
        f"(+ is too deep), {reached['depth_rms_mm']:.2f} mm rms",
        f"  expected: {reached['predicted_rms_mm']:.2f} mm from calibration and arms, "
        f"{reached['predicted_with_reading_rms_mm']:.2f} mm with the reading of the target",
    ]
