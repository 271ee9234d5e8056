"""The tables of Liu et al. 2007, recomputed from their rows, beside a session of ours in a room like theirs.

Liu J., Zhang Y., Li Z., "Visual servoing control in robot-assisted stereotactic neurosurgery", J. Beijing Univ. of
Aeronautics and Astronautics 33(3), 2007. The constants are what the paper prints, mm.

The paper did not measure what the servo alone leaves, |true ball - estimated target|. It can be bounded: by the
triangle's inequality no target of the table can have less than |after - mapping|.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from puncture_twin.meshes import folder
from puncture_twin.planning.base.progress import Count
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase, load_servo_case
from puncture_twin.twin.rehearsal.stereo_session import Session, run_session
from puncture_twin.twin.rehearsal.stereo_trials import ServoTrial, Statistics, run_trials, statistics, trial

TABLE_1 = (0.33, 0.31, 0.19, 0.27, 0.21, 0.26, 0.34, 0.33, 0.38, 0.35)
"""Error of the stereo at ten points."""

TABLE_2 = (
    (0.73, 1.19, 0.76),
    (1.76, 2.29, 1.67),
    (0.88, 1.45, 0.68),
    (1.37, 1.25, 1.39),
    (1.49, 1.49, 1.25),
    (1.67, 1.77, 1.61),
    (0.94, 0.93, 0.97),
    (1.12, 1.67, 0.97),
    (0.96, 0.99, 0.53),
    (0.98, 1.72, 0.91),
    (0.79, 1.27, 0.78),
    (0.61, 2.41, 0.59),
    (1.25, 1.89, 1.41),
    (1.39, 1.47, 1.35),
    (0.74, 0.96, 0.60),
    (0.23, 0.91, 0.58),
)
"""Error of the mapping, before and after the servo, at sixteen targets."""

TABLE_1_PRINTED = (0.30, 0.38)
"""Mean and maximum."""

TABLE_2_PRINTED = ((1.06, 1.76), (1.47, 2.41), (1.00, 1.67))
"""Mean and maximum of mapping, before, after. The mean before is 1.477 by the rows: 1.48, not 1.47."""

ROUNDING_MM = 0.005
"""The paper prints two decimals."""

MOST_OVER_MAPPING = 1.1
"""After the servo, over the mapping's error, which is the floor: what is allowed beyond chance. The paper: 0.94."""

MOST_NOT_CONFIRMED = 0.1
"""Fraction of the targets at which the servo may end without confirming; the paper reports none of sixteen."""

CHANCE = 2.0
"""Standard errors that a condition allows for."""

CASE = "liu2007.toml"
DEFAULT_SEEDS = 8


class PaperMean(NamedTuple):
    """A column of the paper: what it prints, and what its own rows give; mm."""

    name: str
    printed_mean: float
    mean: float
    printed_max: float
    max: float

    @property
    def passed(self) -> bool:
        """Whether mean and maximum are what the rows give, to the paper's rounding."""
        wrong = max(abs(self.mean - self.printed_mean), abs(self.max - self.printed_max))
        return wrong <= ROUNDING_MM + 1e-9


class MeanOfSeeds(NamedTuple):
    """A mean over seeds, and its standard error: targets of one seed share a room, so seeds count, not targets."""

    mean: float
    error: float


class Condition(NamedTuple):
    """What must be so for the paper's finding to hold in our room."""

    text: str
    passed: bool


@dataclass(frozen=True, eq=False)
class ServoSessions:
    """A case's sessions.

    Attributes:
        case: The case.
        first: The session of the first seed, in full.
        trials: Every seed.
        ours: Over all seeds.
    """

    case: ServoCase
    first: Session
    trials: tuple[ServoTrial, ...]
    ours: Statistics

    @property
    def gain(self) -> MeanOfSeeds:
        """By how much the error falls from before to after the servo, mm."""
        return _mean_of_seeds(self.trials, [[row.before_mm - row.after_mm for row in one.rows] for one in self.trials])


@dataclass(frozen=True, eq=False)
class Liu2007Tables:
    """The paper's numbers, and ours.

    Attributes:
        tilted: Sessions in a workcell like the paper's: the rod is tilted more during the calibration than after.
        straight: The same rooms with the rod tilted alike.
    """

    tilted: ServoSessions
    straight: ServoSessions

    @property
    def conditions(self) -> tuple[Condition, ...]:
        """What the exit code stands for; each allows for two standard errors."""
        ours, gain = self.tilted.ours, self.tilted.gain
        over = _mean_of_seeds(
            self.tilted.trials, [[row.after_mm - row.mapping_mm for row in one.rows] for one in self.tilted.trials]
        )
        most = MOST_OVER_MAPPING * ours.mapping_mean + CHANCE * over.error
        fraction = MOST_NOT_CONFIRMED + CHANCE * np.sqrt(MOST_NOT_CONFIRMED * (1 - MOST_NOT_CONFIRMED) / ours.targets)
        return (
            Condition(
                f"the error drops by more than chance: {gain.mean:.2f} mm, standard error {gain.error:.2f}",
                bool(gain.mean > CHANCE * gain.error),
            ),
            Condition(
                f"after the servo, {ours.after_mean:.2f} mm, is at most {most:.2f} (1.1 times the mapping's, plus "
                "chance)",
                bool(ours.after_mean <= most),
            ),
            Condition(
                f"not confirmed, {100 * ours.not_confirmed:.1f} %, is at most {100 * fraction:.0f} % of the targets",
                bool(ours.not_confirmed <= fraction),
            ),
        )

    @property
    def passed(self) -> bool:
        """Whether every condition holds."""
        return all(condition.passed for condition in self.conditions)


def _mean_of_seeds(trials: Sequence[ServoTrial], values: list[list[float]]) -> MeanOfSeeds:
    """Over the seeds whose session could be held; with one seed its targets stand for them, which is too sure."""
    finished = [np.array(rows) for one, rows in zip(trials, values, strict=True) if not one.refused]
    means = np.array([float(rows.mean()) for rows in finished]) if len(finished) > 1 else finished[0]
    error = float(np.std(means, ddof=1) / np.sqrt(len(means))) if len(means) > 1 else float("inf")
    return MeanOfSeeds(float(means.mean()), error)


def paper_columns() -> tuple[PaperMean, ...]:
    """Stereo, mapping, before, after: as printed, and by the rows."""
    rows = np.array(TABLE_2)
    columns = [("stereo", TABLE_1_PRINTED, np.array(TABLE_1))]
    columns += [
        (name, printed, rows[:, i])
        for i, (name, printed) in enumerate(zip(("mapping", "before", "after"), TABLE_2_PRINTED, strict=True))
    ]
    return tuple(
        PaperMean(name, printed[0], float(values.mean()), printed[1], float(values.max()))
        for name, printed, values in columns
    )


def paper_servo_only_at_least() -> tuple[float, ...]:
    """Least error that the servo alone can have had at each of the paper's targets, mm."""
    return tuple(abs(after - mapping) for mapping, _, after in TABLE_2)


def paper_case() -> ServoCase:
    """The embedded room like the paper's."""
    return load_servo_case(folder() / "head" / CASE)


def reproduce(seeds: int | None = None, done: Count | None = None) -> Liu2007Tables:
    """Hold the paper's sessions in the twin.

    Args:
        seeds: How many; the first is the case's own, the others follow it.
        done: Told how many of how many are done.
    """
    tilted, count = paper_case(), seeds or DEFAULT_SEEDS
    report = done or (lambda at, of: None)
    return Liu2007Tables(
        finished_sessions(tilted, count, lambda at, of: report(at, 2 * of)),
        finished_sessions(straightened(tilted), count, lambda at, of: report(at + of, 2 * of)),
    )


def straightened(case: ServoCase) -> ServoCase:
    """The case with the rod tilted during the calibration as it is at the targets."""
    calibration = case.file.calibration.model_copy(update={"tilt_deg": None})
    return replace(case, file=case.file.model_copy(update={"calibration": calibration}))


def paper_gain_mm() -> float:
    """By how much the paper's mean error falls, by its rows."""
    rows = np.array(TABLE_2)
    return float(rows[:, 1].mean() - rows[:, 2].mean())


def finished_sessions(
    case: ServoCase, seeds: int, done: Count | None = None, record: Path | None = None
) -> ServoSessions:
    """The sessions of a case, from its own seed on."""
    first = run_session(case, case.file.seed, record=record)
    report = done or (lambda at, of: None)
    report(1, seeds)
    others: Sequence[ServoTrial] = run_trials(
        case, range(case.file.seed + 1, case.file.seed + seeds), done=lambda at, of: report(at + 1, seeds)
    )
    trials = (trial(first), *others)
    return ServoSessions(case, first, trials, statistics(trials))
