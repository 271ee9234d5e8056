"""The same tour in many truths without physics: a few physical runs cannot tell whether a prediction is right.

A reading of the simulator lies some hundredths of a millimetre from the joints that put the true tip on the true
marker, so a run and its drawn twin err alike; and drawn ones cost milliseconds.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.search.context import CaseContext
from puncture_twin.twin.jobs.experiment.touch_job import Tour, drawn_once

DRAWS = 400
"""Where one axis errs most their rms is known to 3.5 %."""


@dataclass(frozen=True)
class DrawnRuns:
    """Truths drawn alike.

    Attributes:
        alike_mm: The tip's rms error in the truths of the physical runs that ended, mm; NaN where none did.
        realised_mm: The same in all that were drawn.
        draws: How many.
    """

    alike_mm: float
    realised_mm: float
    draws: int

    def text(self, ended: int) -> str:
        """Beside so many physical runs."""
        spread = 100.0 / np.sqrt(2.0 * self.draws)
        return (
            f"  without physics the same {ended} truths give {self.alike_mm:.2f} mm, {self.draws} truths "
            f"{self.realised_mm:.2f} (known to {spread:.1f} %)"
        )


def drawn_runs(context: CaseContext, tour: Tour, ended: Iterable[int], first_seed: int) -> DrawnRuns:
    """Draw the truths of many seeds.

    Args:
        context: As of the physical runs.
        tour: Theirs.
        ended: Seeds of those that ended.
        first_seed: Of the draws.
    """
    error_mm = {seed: _error_mm(context, tour, seed) for seed in range(first_seed, first_seed + DRAWS)}
    alike = [error_mm[seed] if seed in error_mm else _error_mm(context, tour, seed) for seed in ended]
    return DrawnRuns(_rms(alike), _rms(error_mm.values()), DRAWS)


def _error_mm(context: CaseContext, tour: Tour, seed: int) -> float:
    use = drawn_once(context, tour, seed)
    return float("nan") if isinstance(use, str) else use.tip_error_mm


def _rms(errors_mm: Iterable[float]) -> float:
    """Of those that registered; NaN where none did."""
    found = np.array([one for one in errors_mm if not np.isnan(one)])
    return float(np.sqrt(np.mean(found**2))) if len(found) else float("nan")
