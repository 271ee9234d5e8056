"""From a recording to the unknowns: checks, start, fit, noise, and the refusal where the poses cannot show them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.guidance.ultrasound.axp_ybq.arm_errors import DeclaredArms, arm_errors, without_play
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import LEAST_POSES, LEAST_POSES_KNOWN_TIP, closed_form
from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import SeenDirection, needle_direction
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import DIRECTION, Estimate, active_columns
from puncture_twin.twin.guidance.ultrasound.axp_ybq.observability import Observability, WeakMotion, observe
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals import (
    UNWEIGHTED,
    Problem,
    Spread,
    needle_in_image,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.robust import RobustFit, plain_fit, robust_fit, settled, weighed
from puncture_twin.twin.guidance.ultrasound.axp_ybq.spread import SmallSample, found_spreads, small_sample
from puncture_twin.twin.guidance.ultrasound.axp_ybq.suggested_poses import SuggestedPoses, propose

SPREAD_ROUNDS = 2
"""How often the residuals' spread is found and the fit repeated with it; it settles to a few percent in two."""

ADVISED_POSES = 20
"""From 20 poses on the closed form is well conditioned (median 5e2; 6e3 at 16)."""


class Degenerate(InputError):  # noqa: N818 - the field's word for such poses
    """The poses cannot show every unknown.

    Attributes:
        motions: What can move without any residual showing it, in words and with its cause.
        cure: Poses that would mend it.
    """

    def __init__(self, observability: Observability, suggestion: SuggestedPoses) -> None:
        self.motions: tuple[WeakMotion, ...] = observability.weak
        self.ratio = observability.ratio
        self.suggestion = suggestion
        what = "; ".join(motion.text for motion in self.motions) + f" (singular value ratio {self.ratio:.1e})"
        super().__init__(what, where="recording", allowed=suggestion.text)


class Solution(NamedTuple):
    """A fit with all that is known about it."""

    estimate: Estimate
    active: NDArray[np.int_]
    tip_kept: NDArray[np.bool_]
    iterations: int
    noise: Noise | Spread
    covariance: Floats
    """Of the free parameters, then of the arms' lasting errors where they are declared, shape (p + m, p + m)."""
    arm_errors: Floats
    """Posterior mean of the arms' lasting errors, in standard deviations, shape (m,): 46, with
    play in both arms 58, and 0 where none are declared."""
    small_sample: SmallSample | None
    residuals: Floats
    noise_ratio: float
    freedom: int
    observability: Observability
    orientations: Floats


def solve(
    recording: Recording,
    *,
    noise: Noise | None,
    known_tip: Floats | None,
    scale: bool,
    robust: bool,
    direction: bool,
    start: Estimate | None,
    arms: DeclaredArms | None = None,
) -> Solution:
    """The unknowns of a recording; the arguments are those of ``calibration.calibrate``.

    Raises:
        InputError: Too few poses, pixels without scale, or most poses disagree.
        Degenerate: The poses cannot show every unknown.
    """
    _check(recording, known_tip, scale, start)
    errors = None if arms is None else arm_errors(arms, recording)
    if errors is not None:
        recording = without_play(recording, errors)
    estimate = start or closed_form(recording, known_tip=known_tip, scale=scale)
    if start is not None and known_tip is not None:
        estimate = estimate._replace(t_Q=np.asarray(known_tip, dtype=np.float64))
    active = active_columns(tip=known_tip is None, scale=scale, direction=False)
    problem = Problem(recording, noise or UNWEIGHTED, active, arms=errors)
    fit = (robust_fit if robust else plain_fit)(problem, estimate)
    seen = needle_direction(fit.estimate, recording, fit.tip_kept)
    fit = fit._replace(estimate=fit.estimate._replace(V=seen.V), direction_kept=seen.agrees)
    observability = _observed(problem, fit)
    if direction and recording.v is not None:
        active = np.append(active, [DIRECTION.start, DIRECTION.start + 1])
        problem = problem._replace(active=active, lean_rad=seen.lean_rad)
    if noise is None or problem.with_direction:
        before = fit.tip_kept
        problem, fit = _full_fit(problem, fit, seen, robust=robust)
        if not np.array_equal(before, fit.tip_kept):
            observability = _observed(problem, fit)
    return _solution(problem, fit, observability)


def _check(recording: Recording, known_tip: Floats | None, scale: bool, start: Estimate | None) -> None:
    if recording.pixels and not scale:
        raise InputError("the tip is in pixels", where="recording", allowed="mm, or mm per pixel to be found (scale)")
    if known_tip is not None and (np.shape(known_tip) != (3,) or not np.isfinite(known_tip).all()):
        raise InputError(f"known tip {known_tip}", where="known_tip", allowed="three finite numbers, mm, frame end2")
    least = LEAST_POSES if known_tip is None else LEAST_POSES_KNOWN_TIP
    if start is not None:
        least = len(active_columns(tip=known_tip is None, scale=scale, direction=False)) // 3 + 1
    if len(recording) < least:
        allowed = f"{least} or more" + (f", better {ADVISED_POSES}" if least == LEAST_POSES else "")
        raise InputError(f"{len(recording)} poses", where="recording", allowed=allowed)


def _full_fit(problem: Problem, fit: RobustFit, seen: SeenDirection, *, robust: bool) -> tuple[Problem, RobustFit]:
    """Fit again with the directions, and with the spread that the residuals themselves show where no noise is given."""
    declared = not isinstance(problem.noise, Spread)
    if not declared:
        tips = problem._replace(active=problem.active[problem.active < DIRECTION.start])
        problem = problem._replace(noise=found_spreads(tips, fit).spread._replace(direction_rad=seen.spread_rad))
    for _ in range(SPREAD_ROUNDS):
        fit = settled(problem, fit, recheck=robust)
        found = found_spreads(problem, fit)
        problem = problem._replace(noise=problem.noise if declared else found.spread, lean_rad=found.lean_rad)
    return problem, fit


def _solution(problem: Problem, fit: RobustFit, observability: Observability) -> Solution:
    at_fit = weighed(problem, fit)
    count = 3 * int(fit.tip_kept.sum()) + 2 * int(fit.direction_kept.sum()) * problem.with_direction
    freedom = count - len(problem.active)
    region = small_sample(problem, fit) if problem.arms is not None else None
    return Solution(
        fit.estimate,
        problem.active,
        fit.tip_kept,
        fit.iterations,
        problem.noise,
        at_fit.covariance,
        at_fit.shared,
        region,
        at_fit.residuals[:, :3],
        float(np.sqrt(at_fit.chi_squared / max(freedom, 1))),
        freedom,
        observability,
        needle_in_image(fit.estimate, problem.recording),
    )


def _observed(problem: Problem, fit: RobustFit) -> Observability:
    kept = problem.recording.subset(fit.tip_kept)
    found = observe(fit.estimate, kept, problem.active)
    if found.weak:
        raise Degenerate(found, propose(fit.estimate, kept, problem.active))
    return found
