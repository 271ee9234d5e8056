"""The fit of the poses that agree with it: fitted and checked in turn until no pose changes sides."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Bools
from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.guidance.ultrasound.axp_ybq.fitted import RobustFit
from puncture_twin.twin.guidance.ultrasound.axp_ybq.outliers.agreement import agreeing
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import Problem
from puncture_twin.twin.guidance.ultrasound.axp_ybq.refine import refine

LOOKS = 5
"""How often poses may change sides before the last split is kept."""

LEAST_KEPT = 0.5
"""If more than half of the poses disagree, nobody can say which half is right."""


def settled(problem: Problem, fit: RobustFit, *, recheck: bool = True) -> RobustFit:
    """Fit the poses that were kept, check all poses against it, and so on until none changes sides.

    Args:
        problem: It may have grown since the fit (directions, another spread).
        fit: Where to begin.
        recheck: Whether poses may change sides at all.

    Raises:
        InputError: More than half of the poses disagree.
    """
    kept = (fit.tip_kept, fit.direction_kept)
    for _ in range(LOOKS):
        _check_enough(problem, kept[0])
        again = refine(problem, fit.estimate, *kept)
        fit = RobustFit(again.estimate, *kept, fit.iterations + again.iterations)
        kept = agreeing(problem, fit) if recheck else kept
        if all(np.array_equal(new, old) for new, old in zip(kept, fit[1:3], strict=True)):
            break
    return fit


def _check_enough(problem: Problem, kept: Bools) -> None:
    n, unknowns = len(problem.recording), len(problem.active)
    if kept.sum() < max(LEAST_KEPT * n, unknowns / 3 + 1):
        raise InputError(
            f"only {int(kept.sum())} of {n} poses agree with each other",
            where="recording",
            allowed="a recording in which most tips are right",
        )
