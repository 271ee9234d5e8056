"""Many seeds of one case, in processes of this machine, and what they say together."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.processes import process_pool
from puncture_twin.planning.base.progress import Count, uncounted
from puncture_twin.planning.collision.state_checker import StateChecker
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.guidance.stereo.servo_law import ServoStop
from puncture_twin.twin.guidance.stereo.session import Session, run_session
from puncture_twin.twin.guidance.stereo.stereo_room import workcell_checker

SHARE = 5
"""Seeds that a process takes at a time; they share the judge of the empty room."""


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


class ServoTrial(NamedTuple):
    """One seed."""

    seed: int
    stereo_mm: tuple[float, ...]
    rms_px: tuple[float, ...]
    fre_mm: float
    robot_residual_mm: float
    rows: tuple[TargetRow, ...]
    refused: str
    """Why the session could not be held at all; empty when it was."""


class Statistics(NamedTuple):
    """Over all targets of all seeds; mm."""

    seeds: int
    targets: int
    refused: int
    """Seeds whose session could not be held."""
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
    """Share of the targets at which the servo did not converge."""

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
        )
        for one in session.reached
    )
    stereo = tuple(float(error) for error in session.stereo_mm)
    residual = float(np.mean(session.calibration.robot_residual_mm))
    return ServoTrial(session.seed, stereo, session.calibration.rms_px, session.mapping.fre_mm, residual, rows, "")


def run_trial(case: ServoCase, seed: int, empty: StateChecker | None = None) -> ServoTrial:
    """One seed; a session that cannot be held becomes a trial that says why.

    Args:
        case: The case.
        seed: Of all that is drawn.
        empty: Judge of the room without the head, where one is at hand.
    """
    try:
        return trial(run_session(case, seed, empty=empty))
    except NoAnswerError as error:
        return ServoTrial(seed, (), (), float("nan"), float("nan"), (), str(error))


def run_trials(case: ServoCase, seeds: Sequence[int], *, jobs: int = 1, done: Count | None = None) -> list[ServoTrial]:
    """Every seed, in the order given.

    Args:
        case: The case.
        seeds: Which.
        jobs: Processes, at most one a core.
        done: Told how many of how many are done.
    """
    tell = done or uncounted
    found: list[ServoTrial] = []
    if jobs == 1:
        empty = workcell_checker(case, None)
        for seed in seeds:
            found.append(run_trial(case, seed, empty))
            tell(len(found), len(seeds))
        return found
    shares = [seeds[i : i + SHARE] for i in range(0, len(seeds), SHARE)]
    with process_pool(jobs, len(shares)) as pool:
        for share in pool.map(partial(run_trials, case), shares):
            found += share
            tell(len(found), len(seeds))
    return found


def statistics(trials: Sequence[ServoTrial]) -> Statistics:
    """What trials say together.

    Raises:
        NoAnswerError: No trial reached a target.
    """
    rows = [row for one in trials for row in one.rows]
    if not rows:
        raise NoAnswerError("no session could be held: " + "; ".join(sorted({one.refused for one in trials})))
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
