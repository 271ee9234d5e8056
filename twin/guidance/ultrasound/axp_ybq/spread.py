"""How far the residuals spread where nobody says it: inside the image, across it, and in direction."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals import Fitted, Problem, Spread, fitted
from puncture_twin.twin.guidance.ultrasound.axp_ybq.robust import LEAST_MM, RobustFit

LEAST_FREEDOM = 15
"""Residuals minus unknowns below which inside and across are not told apart: their ratio would be chance."""

LEAST_RAD = 1e-9
"""The same for directions."""

WIDEST_RATIO = 30.0
"""Inside and across the image are not taken to differ by more."""


class ResidualSpreads(NamedTuple):
    """What the residuals show."""

    spread: Spread
    lean_rad: float
    """How far the needle leans out of the measured direction's plane across the image."""


def found_spreads(problem: Problem, fit: RobustFit) -> ResidualSpreads:
    """One step of variance component estimation: squares of residuals over what the fit left free of them.

    The fixed point is the restricted maximum likelihood estimate (Förstner 1979).

    Args:
        problem: With the directions where they take part, and with the spreads found so far.
        fit: Its fit.
    """
    at_fit = fitted(problem, fit.estimate, fit.tip_kept, fit.direction_kept)
    turn, lean = 1.0, problem.lean_rad
    if problem.with_direction:
        turn, lean = (_direction_part(at_fit, fit, column) for column in (3, 4))
        arms = 0.0 if isinstance(problem.noise, Spread) else 2 * problem.noise.robot_rad**2
        lean = float(np.sqrt(max(lean**2 - arms, arms / 100, LEAST_RAD**2)))
    return ResidualSpreads(Spread(*_tip_parts(problem, at_fit, fit), turn), lean)


def _tip_parts(problem: Problem, at_fit: Fitted, fit: RobustFit) -> tuple[float, float]:
    """Spread of the tip's residuals inside and across the image, mm."""
    to_image = (problem.recording.A[:, :3, :3] @ fit.estimate.R_X).transpose(0, 2, 1)[fit.tip_kept]
    r = (to_image @ at_fit.residuals[fit.tip_kept, :3, None])[:, :, 0]
    J = to_image @ at_fit.jacobian[fit.tip_kept, :3]
    sigma = to_image @ at_fit.sigma[fit.tip_kept, :3, :3] @ to_image.transpose(0, 2, 1)
    taken = ((J @ at_fit.covariance) * J).sum(axis=2) / np.diagonal(sigma, axis1=1, axis2=2)
    return _two_parts((r**2).sum(axis=0), len(r) - taken.sum(axis=0))


def _direction_part(at_fit: Fitted, fit: RobustFit, column: int) -> float:
    """Spread of one of the direction's two residuals, rad."""
    used = fit.direction_kept
    r, J, expected = at_fit.residuals[used, column], at_fit.jacobian[used, column], at_fit.sigma[used, column, column]
    freedom = len(r) - float((((J @ at_fit.covariance) * J).sum(axis=1) / expected).sum())
    return max(float(np.sqrt(r @ r / max(freedom, 1.0))), LEAST_RAD)


def _two_parts(squares: Floats, freedom: Floats) -> tuple[float, float]:
    pooled = max(float(np.sqrt(squares.sum() / max(freedom.sum(), 1.0))), LEAST_MM)
    if freedom.sum() < LEAST_FREEDOM or freedom[2] < LEAST_FREEDOM / 5:
        return pooled, pooled
    inside = float(np.sqrt(squares[:2].sum() / freedom[:2].sum()))
    across = float(np.sqrt(squares[2] / freedom[2]))
    least = max(inside, across, LEAST_MM) / WIDEST_RATIO
    return max(inside, least), max(across, least)
