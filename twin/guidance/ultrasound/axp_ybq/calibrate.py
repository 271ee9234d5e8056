"""From a recording to a calibration of A X P = Y B Q: checks, closed form, robust fit, noise.

It is refused where the poses cannot determine every unknown. Letters and frames: docs/concepts/selfcalibration.md.
"""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.text import plural
from puncture_twin.twin.guidance.ultrasound.axp_ybq.arm_errors import DeclaredArms, arm_errors, without_play
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration, calibration_of, with_length
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import (
    DIRECTION,
    LEAST_POSES,
    LEAST_POSES_KNOWN_TIP,
    Estimate,
    active_columns,
    closed_form,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import SeenDirection, needle_direction
from puncture_twin.twin.guidance.ultrasound.axp_ybq.noise import refitted
from puncture_twin.twin.guidance.ultrasound.axp_ybq.observability import Observability, require_observable
from puncture_twin.twin.guidance.ultrasound.axp_ybq.outliers import robust_fit
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import UNWEIGHTED, Problem, Spread
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.refine import RobustFit

SHAFT_BIAS = (
    "a constant error of the detected tip along the shaft shifts the tip in the needle's flange frame but changes no "
    "residual; a known needle length would fix it"
)

ARMS_TAKEN = (
    "errors of the arms that repeat from pose to pose (lengths, joint zeros): none were declared together with the "
    "joints, so the stated errors count only noise and are too small"
)

PLAY_SIGN = (
    "on which side of their backlash the joints were: the recording does not state how they rotated, so backlash "
    "counts as noise, and the region is too narrow where the noise was estimated"
)

DIRECTION_SIGN = (
    "no directions were measured: the needle's axis comes from the image plane alone, pointing from flange to tip"
)

ADVISED_POSES = 20
"""From 20 poses on the closed form is well conditioned (median 5e2; 6e3 at 16)."""


def calibrate(
    recording: Recording,
    *,
    noise: Noise | None = None,
    known_tip: Floats | None = None,
    needle_length_mm: float | None = None,
    scale: bool = False,
    direction: bool = True,
    arms: DeclaredArms | None = None,
) -> Calibration:
    """Solve A X P = Y B Q: closed form, then weighted least squares over the poses that agree.

    A: T_base1_end1, B: T_base2_end2, of every pose; P: the tip in the image; X: T_end1_image; Y: T_base1_base2; Q: the
    tip in end2.

    Args:
        recording: At least 16 poses (20 are better); 7 with ``known_tip``; one more where P has three coordinates.
        noise: Of both arms and the image; None estimates the residuals' spread, inside and across the image.
        known_tip: t_Q, shape (3,), mm, frame end2, where it is known.
        needle_length_mm: Distance along the shaft from the flange's origin to the tip: determines a constant error of
            the detected tip along the shaft, which nothing else does.
        scale: Whether mm per unit of P, along both axes of the image, is estimated.
        direction: Whether measured needle directions take part, where the recording has them.
        arms: Declared errors of both arms that repeat from pose to pose; the recording then needs joints. None takes
            all errors of the flanges for noise.

    Raises:
        InputError: Too few poses, or more than half of them disagree; joints that are missing or of another arm.
        Degenerate: The poses cannot show every unknown. It names the motion and proposes further poses.
    """
    if needle_length_mm is not None and not 0 < needle_length_mm < np.inf:
        refuse(f"needle length {needle_length_mm}", "needle_length_mm", "a positive number, mm", "not_positive")
    _check(recording, known_tip, scale)
    # 1. Where to begin.
    errors = None if arms is None else arm_errors(arms, recording)
    poses = recording if errors is None else without_play(recording, errors)
    estimate = closed_form(poses, known_tip=known_tip, scale=scale)
    # 2. The fit: outliers, observability, directions, noise.
    active = active_columns(tip=known_tip is None, scale=scale, direction=False)
    problem = Problem(poses, noise or UNWEIGHTED, active, arms=errors)
    solved = _solve(problem, estimate, direction=direction and recording.v is not None)
    # 3. What the recording cannot show, and the result with its covariance.
    cannot = [SHAFT_BIAS] * (needle_length_mm is None and known_tip is None)
    cannot += [DIRECTION_SIGN] * (recording.v is None) + [ARMS_TAKEN] * (arms is None)
    if arms is not None and recording.turn_probe is None and any(arm.errors.backlash > 0.0 for arm in arms):
        cannot.append(PLAY_SIGN)
    found = calibration_of(*solved, tuple(cannot), arms)
    return found if needle_length_mm is None or known_tip is not None else with_length(found, needle_length_mm)


def _check(recording: Recording, known_tip: Floats | None, scale: bool) -> None:
    if recording.pixels and not scale:
        refuse("the tip is in pixels", "recording", "mm, or scale to estimate mm per pixel", "wrong_unit")
    if known_tip is not None and (np.shape(known_tip) != (3,) or not np.isfinite(known_tip).all()):
        refuse(f"known tip {known_tip}", "known_tip", "three finite numbers, mm, frame end2", "not_finite")
    if scale and recording.P.shape[1] == 3:
        refuse("three coordinates and scale", "recording", "three coordinates in mm", "wrong_unit")
    least = (LEAST_POSES if known_tip is None else LEAST_POSES_KNOWN_TIP) + (recording.P.shape[1] == 3)
    if len(recording) < least:
        allowed = f"{least} or more" + (f", preferably {ADVISED_POSES}" if least >= LEAST_POSES else "")
        missed = f" (and {plural(len(recording.missed), 'picture')} without a needle)" if recording.missed else ""
        refuse(plural(len(recording), "pose") + missed, "recording", allowed, "too_few_poses")


def _solve(
    problem: Problem, start: Estimate, *, direction: bool
) -> tuple[Problem, RobustFit, Observability, SeenDirection]:
    """Fit the tips, require that all unknowns are observable, then fit again with directions and estimated noise.

    Raises:
        InputError: Most poses disagree, or the directions contradict them.
        Degenerate: The poses cannot show every unknown.
    """
    recording = problem.recording
    fit = robust_fit(problem, start)
    try:
        seen = needle_direction(fit.estimate, recording, fit.tip_kept)
    except InputError:  # directions say little of poses that show too little
        require_observable(fit.estimate, recording.subset(fit.tip_kept), problem.active)
        raise
    fit = fit._replace(estimate=fit.estimate._replace(V=seen.V), direction_kept=seen.agrees)
    observability = require_observable(fit.estimate, recording.subset(fit.tip_kept), problem.active)
    if direction:
        active = np.append(problem.active, [DIRECTION.start, DIRECTION.start + 1])
        problem = problem._replace(active=active, lean_rad=seen.lean_rad)
    if isinstance(problem.noise, Spread) or problem.with_direction:
        before = fit.tip_kept
        problem, fit = refitted(problem, fit, seen)
        if not np.array_equal(before, fit.tip_kept):
            observability = require_observable(fit.estimate, recording.subset(fit.tip_kept), problem.active)
    return problem, fit, observability, seen
