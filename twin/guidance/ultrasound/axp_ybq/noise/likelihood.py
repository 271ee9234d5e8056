"""The parts of the noise by restricted maximum likelihood, beside declared errors of the arms.

The residuals' covariance is C = sum_k v_k D_k + what is declared. The likelihood demands of every part that

    r^T P D_k P r = tr(P D_k),   P = C^-1 - C^-1 J (J^T C^-1 J)^-1 J^T C^-1,

and the ratio of the two sides is the factor by which v_k is moved.
"""

from __future__ import annotations

import numpy as np

from puncture_twin.twin.guidance.ultrasound.axp_ybq.fitted import Fitted, RobustFit, weighed
from puncture_twin.twin.guidance.ultrasound.axp_ybq.noise.parts import WIDEST_RATIO, ResidualSpreads, structures
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import LEAST_MM, UNWEIGHTED, Problem, Spread

STEPS = 12
"""Of the parts' sizes between two fits, by likelihood; each comes within a few percent in half as many."""

LEAST_PART_FREEDOM = 3.0
"""Residuals minus unknowns of one part of the tip's noise below which both parts are found together."""

LEAST_PART_RAD = 1e-6
"""No direction is measured better, and none leans less."""


def by_likelihood(problem: Problem, fit: RobustFit) -> ResidualSpreads:
    """The parts' sizes at a fit, by restricted maximum likelihood."""
    declared = not isinstance(problem.noise, Spread)
    found = ResidualSpreads(problem.noise if isinstance(problem.noise, Spread) else UNWEIGHTED, problem.lean_rad)
    for _ in range(STEPS):
        problem = problem._replace(noise=problem.noise if declared else found.spread, lean_rad=found.lean_rad)
        at_fit = weighed(problem, fit)
        found = _step(problem, fit, at_fit, found)
    return found


def _step(problem: Problem, fit: RobustFit, at_fit: Fitted, found: ResidualSpreads) -> ResidualSpreads:
    """Each part times the root of what its residuals are over what is expected of them."""
    W = at_fit.whitener
    own = W.transpose(0, 2, 1) @ W
    q = own @ at_fit.residuals[:, :, None]
    pulled = own @ at_fit.jacobian
    E = own - pulled @ at_fit.covariance @ pulled.transpose(0, 2, 1)
    sides = {
        name: (float((q.transpose(0, 2, 1) @ D @ q).sum()), float(np.einsum("nij,nji->", D, E)))
        for name, D in structures(problem, fit).items()
    }
    spread, lean = found
    if "inside" in sides:
        inside, across = _moved_tip_parts(spread, sides["inside"], sides["across"])
        turn = spread.direction_rad
        if "turn" in sides:
            turn = max(turn * _growth(sides["turn"]), LEAST_PART_RAD)
        spread = Spread(inside, across, turn)
    if "lean" in sides:
        lean = max(lean * _growth(sides["lean"]), LEAST_PART_RAD)
    return ResidualSpreads(spread, lean)


def _moved_tip_parts(spread: Spread, inside: tuple[float, float], across: tuple[float, float]) -> tuple[float, float]:
    if min(inside[1] * spread.inside_mm**2, across[1] * spread.across_mm**2) < LEAST_PART_FREEDOM:
        both = _growth((inside[0] + across[0], inside[1] + across[1]))
        return max(spread.inside_mm * both, LEAST_MM), max(spread.inside_mm * both, LEAST_MM)
    sizes = spread.inside_mm * _growth(inside), spread.across_mm * _growth(across)
    least = max(*sizes, LEAST_MM) / WIDEST_RATIO
    return max(sizes[0], least), max(sizes[1], least)


def _growth(sides: tuple[float, float]) -> float:
    return float(np.sqrt(sides[0] / max(sides[1], 1e-300)))
