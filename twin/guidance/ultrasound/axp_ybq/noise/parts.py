"""The parts of the noise that the residuals themselves show, and each part's covariance of the residuals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.ultrasound.axp_ybq.fitted import RobustFit
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import Problem, Spread

WIDEST_RATIO = 30.0
"""Inside and across the image are not taken to differ by more."""


class ResidualSpreads(NamedTuple):
    """What the residuals show."""

    spread: Spread
    lean_rad: float
    """How far the needle leans out of the measured direction's plane across the image."""


def structures(problem: Problem, fit: RobustFit) -> dict[str, Floats]:
    """Covariance of the residuals (n, k, k) that each found part has at size 1, by its name."""
    image = problem.recording.A[:, :3, :3] @ fit.estimate.R_X
    n, k = len(problem.recording), 5 if problem.with_direction else 3
    found: dict[str, Floats] = {}
    if isinstance(problem.noise, Spread):
        for name, axes in (("inside", image[:, :, :2]), ("across", image[:, :, 2:])):
            found[name] = np.zeros((n, k, k))
            found[name][:, :3, :3] = axes @ axes.transpose(0, 2, 1)
    if problem.with_direction:
        rows = {"lean": 4} if not found else {"turn": 3, "lean": 4}
        for name, row in rows.items():
            found[name] = np.zeros((n, k, k))
            found[name][:, row, row] = problem.recording.direction_spread**2 if name == "turn" else 1.0
    return found
