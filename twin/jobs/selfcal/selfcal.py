"""The self-calibration from end to end: in the twin (truth, poses, pictures, detection) or from a recording."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.progress import Stages, Watcher
from puncture_twin.planning.base.provenance import Input
from puncture_twin.twin.guidance.ultrasound.acquisition import Acquisition, choice_noise
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.shots import Shot, ShotByShot
from puncture_twin.twin.guidance.ultrasound.pose_choice import CandidatePoses, drawing, expected_tre_mm, find_candidates
from puncture_twin.twin.guidance.ultrasound.puncture import predicted_tre
from puncture_twin.twin.guidance.ultrasound.recording_file import open_recording, recording_file
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase
from puncture_twin.twin.guidance.ultrasound.slips import checked_calibration, held_length_mm
from puncture_twin.twin.guidance.ultrasound.two_arms import TwoArms
from puncture_twin.twin.rehearsal.selfcal_trial import Puncture, SelfcalTrial, run_trial

NO_JOINTS = "{file}: no joints (columns A_q1_deg to B_q6_deg): the declared arm errors of the case are not counted"

MOST_MISSED = "{file}: no needle in {missed} pictures, and one in {shown}: is the display that of the case's machine?"

RANDOM_SETS = 50
"""Random choices that the informative one is compared with."""


@dataclass(frozen=True, eq=False)
class SelfcalRun:
    """What the command did.

    Attributes:
        trials: In the twin, one per seed; empty for a recording.
        warnings: What the recording leaves open, one sentence each.
        shots: What came of each shot after the recording.
    """

    name: str
    calibration: Calibration
    recording: Recording
    inputs: tuple[Input, ...]
    trials: tuple[SelfcalTrial, ...] = ()
    case: SelfcalCase | None = None
    candidates: CandidatePoses | None = None
    choice: dict[str, Any] | None = None
    stages: Stages = field(default_factory=Stages)
    files: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()
    shots: tuple[Shot, ...] = ()

    @property
    def punctures(self) -> tuple[Puncture, ...]:
        """Of all seeds."""
        return tuple(one for trial in self.trials for one in trial.punctures)

    def with_files(self, *files: Path) -> SelfcalRun:
        """This run with the files that were written."""
        return replace(self, files=(*self.files, *files))


def selfcal_twin(case: SelfcalCase, seeds: int, watcher: Watcher) -> SelfcalRun:
    """Draw ``seeds`` rooms from the case's seed on; record, calibrate and puncture in each.

    Raises:
        Degenerate: The poses cannot show every unknown.
        NoAnswerError: Not enough poses can be taken or show the needle.
    """
    stages = Stages()
    with stages.time("room"):
        workcell = TwoArms(case)
    with stages.time("candidates"):
        candidates = find_candidates(case, workcell, np.random.default_rng(case.content.seed))
    trials = []
    for seed in range(case.content.seed, case.content.seed + seeds):
        trials.append(run_trial(case, workcell, candidates, seed, stages, watcher))
    with stages.time("comparison with random choice"):
        choice = compare_choice(case, candidates, trials[0].acquisition)
    first = trials[0]
    return SelfcalRun(
        case.content.name,
        first.calibration,
        first.acquisition.recording,
        case.inputs,
        tuple(trials),
        case,
        candidates,
        choice,
        stages,
        warnings=first.calibration.warnings(),
    )


def selfcal_recording(path: Path, case: SelfcalCase | None, shots: Path | None = None) -> SelfcalRun:
    """Calibrate from a recording's CSV, or a folder with ``recording.csv``; a case says noise and needle length.

    Args:
        shots: A recording of what was seen afterwards: each of its poses updates the calibration; None for none.

    Raises:
        InputError: A recording that cannot be used, or that fits only in another reading (inverse, swapped, metres).
        Degenerate: The poses cannot show every unknown.
    """
    file = recording_file(path)
    stages = Stages()
    with stages.time("read"):
        recording, inputs, warnings = open_recording(path, case)
    with stages.time("calibrate"):
        calibration = checked_calibration(recording, case, file, hold=shots is None)
    tried: tuple[Shot, ...] = ()
    if shots is not None:
        with stages.time("shots"):
            following = ShotByShot.of(calibration)
            more, files, notes = open_recording(shots, case)
            for row in range(len(more)):
                following = following.with_shot(more.subset(slice(row, row + 1)))
            calibration = following.calibration(needle_length_mm=held_length_mm(case))
        tried, inputs, warnings = following.shots, (*inputs, *files), (*warnings, *notes)
    inputs = (*inputs, *(() if case is None else case.inputs))
    warnings = (*warnings, *calibration.warnings())
    if len(recording.missed) > len(recording):
        warnings += (MOST_MISSED.format(file=file.name, missed=len(recording.missed), shown=len(recording)),)
    if case is not None and calibration.arms is None:
        warnings += (NO_JOINTS.format(file=file.name),)
    return SelfcalRun(
        file.stem, calibration, recording, inputs, case=case, stages=stages, warnings=warnings, shots=tried
    )


def compare_choice(case: SelfcalCase, candidates: CandidatePoses, taken: Acquisition) -> dict[str, Any]:
    """The gain by choosing poses: Cramer-Rao bounds over all candidates of those recorded and of random ones, mm."""
    noise, belief, poses = choice_noise(case), drawing(case), candidates.poses
    rng = np.random.default_rng(case.content.seed)
    rows = np.array([shot.candidate for shot in taken.shots])

    def expected(some: NDArray[np.int_]) -> float:
        return expected_tre_mm(poses.subset(some), noise, belief, poses, case.declared_arms)

    sets = [rng.choice(len(poses), len(rows), replace=False) for _ in range(RANDOM_SETS)]
    chosen, drawn = expected(rows), [expected(some) for some in sets]
    return {
        "chosen_bound_mm": chosen,
        "random_bound_median_mm": float(np.median(drawn)),
        "random_bound_best_mm": min(drawn),
        "random_sets": len(drawn),
    }


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
        "without_needle": dict(recording.missed),
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
    names = {"inside_mm": "inside_image_mm", "across_mm": "across_image_mm"}
    return {
        names.get(key, key.replace("_rad", "_deg")): float(np.degrees(value)) if key.endswith("_rad") else value
        for key, value in found.noise._asdict().items()
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
