"""Many seeds of one servo case, in processes of this machine, and the statistics over them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.processes import process_pool
from puncture_twin.planning.base.progress import Count, uncounted
from puncture_twin.planning.collision.state_checker import StateChecker
from puncture_twin.twin.guidance.stereo.planned import workcell_checker
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.guidance.stereo.servo_law import ServoStop
from puncture_twin.twin.rehearsal.stereo_session import NeedleOutcome, Session, run_session

BATCH = 5
"""Seeds that a process takes at a time; they share the checker of the empty workcell."""


class TargetRow(NamedTuple):
    """One target of one seed, as plain values; mm."""

    seed: int
    target: str
    mapping_mm: float
    expected_tre_mm: float
    before_mm: float
    after_mm: float
    servo_only_mm: float
    steps: int
    stop: str
    needle_open_loop: NeedleOutcome | None = None
    """The needle where the robot alone brought it, predicted and realised; None where there is no prediction."""
    needle_servoed: NeedleOutcome | None = None
    """The needle at the last image of the servo, predicted and realised."""


class DeclarationTest(NamedTuple):
    """Test whether the measurements are as far apart as the declared errors make them."""

    chi_squared: float
    """Chi-squared of the joint estimate's residuals."""
    freedom: int

    @property
    def p(self) -> float:
        """Chance of residuals so large, or larger, if the declaration holds."""
        return float(chdtrc(self.freedom, self.chi_squared))


class ServoTrial(NamedTuple):
    """Result of one seed."""

    seed: int
    stereo_mm: tuple[float, ...]
    rms_px: tuple[float, ...]
    fre_mm: float
    robot_residual_mm: float
    rows: tuple[TargetRow, ...]
    refused: str
    """Why the session failed as a whole; empty when it did not."""
    declaration: DeclarationTest | None = None
    """Test of everything that was measured; None where the joint estimate does not settle."""


class NeedleStatistics(NamedTuple):
    """Predicted and realised errors over the needles of all seeds that have a prediction; mm."""

    needles: int
    predicted_rms_mm: float
    realised_rms_mm: float
    predicted_direction_deg: float
    """Rms."""
    realised_direction_deg: float
    """Rms."""
    coverage_95: float
    """Fraction of the 95 % ellipsoids that hold the true tip."""
    hit_share: float | None
    """None where the case states no radius."""
    mean_p_hit: float | None


class Statistics(NamedTuple):
    """Statistics over all targets of all seeds; mm."""

    seeds: int
    targets: int
    refused: int
    """Seeds whose session failed."""
    stereo_mean: float
    stereo_max: float
    mapping_mean: float
    expected_tre_rms: float
    mapping_rms: float
    before_mean: float
    after_mean: float
    servo_only_mean: float
    servo_only_max: float
    median_steps: float
    not_confirmed: float
    """Fraction of the targets at which the servo did not converge."""

    @property
    def after_over_mapping(self) -> float:
        """Mean error after the servo over the mean error of the mapping: 1 is the floor."""
        return self.after_mean / self.mapping_mean


def trial(session: Session) -> ServoTrial:
    """A session as plain values."""
    rows = tuple(
        TargetRow(
            session.seed,
            one.target,
            one.mapping_mm,
            one.expected_tre_mm,
            one.before_mm,
            one.after_mm,
            one.servo_only_mm,
            one.servoed.steps,
            str(one.servoed.stop),
            one.unseen,
            one.seen,
        )
        for one in session.reached
    )
    stereo = tuple(float(error) for error in session.stereo_mm)
    residual = float(np.mean(session.calibration.robot_residual_mm))
    figures = (session.calibration.rms_px, session.mapping.fre_mm, residual, rows, "", _declaration(session))
    return ServoTrial(session.seed, stereo, *figures)


def _declaration(session: Session) -> DeclarationTest | None:
    try:
        found = session.guide.adjusted()
    except NoAnswerError:
        return None
    return DeclarationTest(found.chi2, found.freedom)


def declaration_test(trials: Sequence[ServoTrial]) -> DeclarationTest | None:
    """Test of the declaration over all seeds together; None where none has a test."""
    known = [one.declaration for one in trials if one.declaration is not None]
    if not known:
        return None
    return DeclarationTest(sum(one.chi_squared for one in known), sum(one.freedom for one in known))


def run_trial(case: ServoCase, seed: int, empty: StateChecker | None = None) -> ServoTrial:
    """The trial of one seed; a session that fails becomes a trial with its reason.

    Args:
        case: The case.
        seed: Of all that is drawn.
        empty: Checker of the workcell without the head, where one is at hand.
    """
    try:
        return trial(run_session(case, seed, empty=empty))
    except NoAnswerError as error:
        return ServoTrial(seed, (), (), float("nan"), float("nan"), (), str(error))


def run_trials(case: ServoCase, seeds: Sequence[int], *, jobs: int = 1, done: Count | None = None) -> list[ServoTrial]:
    """The trials of every seed, in the order given.

    Args:
        case: The case.
        seeds: Which.
        jobs: Processes, at most one a core.
        done: Told how many of how many are done.
    """
    report = done or uncounted
    found: list[ServoTrial] = []
    if jobs == 1:
        empty = workcell_checker(case, None)
        for seed in seeds:
            found.append(run_trial(case, seed, empty))
            report(len(found), len(seeds))
        return found
    fractions = [seeds[i : i + BATCH] for i in range(0, len(seeds), BATCH)]
    with process_pool(jobs, len(fractions)) as pool:
        for fraction in pool.map(partial(run_trials, case), fractions):
            found += fraction
            report(len(found), len(seeds))
    return found


def statistics(trials: Sequence[ServoTrial]) -> Statistics:
    """Statistics over trials.

    Raises:
        NoAnswerError: No trial reached a target.
    """
    rows = [row for one in trials for row in one.rows]
    if not rows:
        what = "no session was possible: " + "; ".join(sorted({one.refused for one in trials}))
        raise NoAnswerError(what, code="no_session")
    stereo = np.concatenate([one.stereo_mm for one in trials])
    mapping, expected, before, after, only = (
        np.array([getattr(row, name) for row in rows])
        for name in ("mapping_mm", "expected_tre_mm", "before_mm", "after_mm", "servo_only_mm")
    )
    return Statistics(
        len(trials),
        len(rows),
        sum(bool(one.refused) for one in trials),
        float(stereo.mean()),
        float(stereo.max()),
        float(mapping.mean()),
        float(np.sqrt(np.mean(expected**2))),
        float(np.sqrt(np.mean(mapping**2))),
        float(before.mean()),
        float(after.mean()),
        float(only.mean()),
        float(only.max()),
        float(np.median([row.steps for row in rows])),
        float(np.mean([row.stop != ServoStop.CONVERGED for row in rows])),
    )


def needle_statistics(outcomes: Sequence[NeedleOutcome | None]) -> NeedleStatistics | None:
    """Statistics over needles; None where none has a prediction. Those of one seed share a workcell."""
    known = [one for one in outcomes if one is not None]
    if not known:
        return None

    def rms(name: str) -> float:
        return float(np.sqrt(np.mean([getattr(one, name) ** 2 for one in known])))

    chances = [one.p_hit for one in known if one.p_hit is not None]
    return NeedleStatistics(
        needles=len(known),
        predicted_rms_mm=rms("predicted_rms_mm"),
        realised_rms_mm=rms("realised_mm"),
        predicted_direction_deg=rms("predicted_direction_deg"),
        realised_direction_deg=rms("realised_direction_deg"),
        coverage_95=float(np.mean([one.in_region for one in known])),
        hit_share=float(np.mean([bool(one.hit) for one in known])) if chances else None,
        mean_p_hit=float(np.mean(chances)) if chances else None,
    )
