"""One draw of the truth and what came of it, and what choosing poses was worth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.ultrasound.acquisition import Acquisition
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.puncture import Puncture
from puncture_twin.twin.guidance.ultrasound.selfcal_truth import WorkcellTruth


@dataclass(frozen=True, eq=False)
class SelfcalTrial:
    """One seed in the twin: a room, its recording, its calibration, and what came of it.

    Attributes:
        seed: Of this trial.
        truth: The room.
        acquisition: What was recorded.
        calibration: What was found.
        unseen_mm: Predicted minus true tip at poses that were not recorded, shape (k,).
        punctures: One per target.
    """

    seed: int
    truth: WorkcellTruth
    acquisition: Acquisition
    calibration: Calibration
    unseen_mm: Floats
    punctures: tuple[Puncture, ...]


@dataclass(frozen=True)
class Choice:
    """What choosing poses is worth, by the Cramer-Rao bound over all candidates, mm."""

    chosen_mm: float
    random_mm: tuple[float, ...]
    """Of random choices of as many poses."""

    @property
    def median_random_mm(self) -> float:
        """Median of the random ones."""
        return float(np.median(self.random_mm))
