"""How far the residuals spread where no noise is declared: inside the image, across it, and in direction."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import SeenDirection
from puncture_twin.twin.guidance.ultrasound.axp_ybq.fitted import Fitted, RobustFit, weighed
from puncture_twin.twin.guidance.ultrasound.axp_ybq.noise.likelihood import by_likelihood
from puncture_twin.twin.guidance.ultrasound.axp_ybq.noise.parts import WIDEST_RATIO, ResidualSpreads
from puncture_twin.twin.guidance.ultrasound.axp_ybq.outliers.settled import settled
from puncture_twin.twin.guidance.ultrasound.axp_ybq.parameters import DIRECTION
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import LEAST_MM, Problem, Spread

SPREAD_ROUNDS = 2
"""How often the residuals' spread is found and the fit repeated with it; it settles to a few percent in two."""

LEAST_FREEDOM = 15
"""Residuals minus unknowns below which inside and across are not told apart: their ratio would be chance."""

LEAST_RAD = 1e-9
"""The same for directions."""


def refitted(problem: Problem, fit: RobustFit, seen: SeenDirection, *, recheck: bool) -> tuple[Problem, RobustFit]:
    """Fit again with the directions, and with the spread that the residuals themselves show where no noise is given.

    Args:
        problem: With the directions where they take part.
        fit: Of the tips alone.
        seen: The needle's direction at that fit.
        recheck: Whether poses may change sides.
    """
    declared = not isinstance(problem.noise, Spread)
    if not declared:
        tips = problem._replace(active=problem.active[problem.active < DIRECTION.start])
        problem = problem._replace(noise=found_spreads(tips, fit).spread._replace(direction_rad=seen.spread_rad))
    for _ in range(SPREAD_ROUNDS):
        fit = settled(problem, fit, recheck=recheck)
        found = found_spreads(problem, fit)
        problem = problem._replace(noise=problem.noise if declared else found.spread, lean_rad=found.lean_rad)
    return problem, fit


def found_spreads(problem: Problem, fit: RobustFit) -> ResidualSpreads:
    """One step of variance component estimation: squares of residuals over what the fit left free of them.

    The fixed point is the restricted maximum likelihood estimate (Förstner 1979). With errors of the arms it is gone
    to at once.

    Args:
        problem: With the directions where they take part, and with the spreads found so far.
        fit: Its fit.
    """
    if problem.arms is not None:
        return by_likelihood(problem, fit)
    at_fit = weighed(problem, fit)
    turn, lean = 1.0, problem.lean_rad
    if problem.with_direction:
        turn = _direction_part(at_fit, fit, 3, problem.recording.direction_spread)
        lean = _direction_part(at_fit, fit, 4, np.ones(len(problem.recording)))
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


def _direction_part(at_fit: Fitted, fit: RobustFit, column: int, spread: Floats) -> float:
    """Of one of the direction's two residuals, rad: what its spread (n,), whose mean square is 1, is multiplied by."""
    used = fit.direction_kept
    r, J, expected = at_fit.residuals[used, column], at_fit.jacobian[used, column], at_fit.sigma[used, column, column]
    freedom = len(r) - float((((J @ at_fit.covariance) * J).sum(axis=1) / expected).sum())
    return max(float(np.sqrt(np.sum((r / spread[used]) ** 2) / max(freedom, 1.0))), LEAST_RAD)


def _two_parts(squares: Floats, freedom: Floats) -> tuple[float, float]:
    pooled = max(float(np.sqrt(squares.sum() / max(freedom.sum(), 1.0))), LEAST_MM)
    if freedom.sum() < LEAST_FREEDOM or freedom[2] < LEAST_FREEDOM / 5:
        return pooled, pooled
    inside = float(np.sqrt(squares[:2].sum() / freedom[:2].sum()))
    across = float(np.sqrt(squares[2] / freedom[2]))
    least = max(inside, across, LEAST_MM) / WIDEST_RATIO
    return max(inside, least), max(across, least)
