"""Parts of the noise as the residuals show them, and the confidence region of unknowns estimated with them.

The residuals' covariance is C = sum_k v_k D_k + what is declared. The likelihood demands of every part that

    r^T P D_k P r = tr(P D_k),   P = C^-1 - C^-1 J (J^T C^-1 J)^-1 J^T C^-1,

and the ratio of the two sides is the factor by which v_k is moved. The region where v was found from few residuals:
Kenward and Roger, "Small sample inference for fixed effects from restricted maximum likelihood", Biometrics 53(3),
1997: an F whose freedom comes from the uncertainty of v, Var(v)^-1 = tr(P D_k P D_l) / 2, and a covariance with that
uncertainty in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import f

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import DIRECTION
from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import SeenDirection
from puncture_twin.twin.guidance.ultrasound.axp_ybq.outliers import settled
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import LEAST_MM, UNWEIGHTED, Problem, Spread
from puncture_twin.twin.guidance.ultrasound.axp_ybq.refine import Fitted, RobustFit, weighed


class ResidualSpreads(NamedTuple):
    """Noise as the residuals show it."""

    spread: Spread
    lean_rad: float
    """How far the needle leans out of the measured direction's plane across the image."""


SPREAD_ROUNDS = 2
"""How often the residuals' spread is found and the fit repeated with it; it settles to a few percent in two."""


def refitted(problem: Problem, fit: RobustFit, seen: SeenDirection) -> tuple[Problem, RobustFit]:
    """Fit again with the directions, and with the spread that the residuals themselves show where no noise is given.

    Args:
        problem: With the directions where they take part.
        fit: Of the tips alone.
        seen: The needle's direction at that fit.
    """
    declared = not isinstance(problem.noise, Spread)
    if not declared:
        tips = problem._replace(active=problem.active[problem.active < DIRECTION.start])
        problem = problem._replace(noise=found_spreads(tips, fit).spread._replace(direction_rad=seen.spread_rad))
    for _ in range(SPREAD_ROUNDS):
        fit = settled(problem, fit)
        found = found_spreads(problem, fit)
        problem = problem._replace(noise=problem.noise if declared else found.spread, lean_rad=found.lean_rad)
    return problem, fit


def found_spreads(problem: Problem, fit: RobustFit) -> ResidualSpreads:
    """One step of variance component estimation: squares of residuals over what the fit left free of them.

    The fixed point is the restricted maximum likelihood estimate (Förstner 1979). With errors of the arms it is gone
    to at once.

    Args:
        problem: With the directions where they take part, and with the spreads found so far.
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


LEAST_FREEDOM = 15
"""Residuals minus unknowns below which inside and across are not distinguished: their ratio would be chance."""

LEAST_RAD = 1e-9
"""Least deviation of directions that is estimated, rad: it keeps weights finite."""

WIDEST_RATIO = 30.0
"""Inside and across the image are not taken to differ by more."""


def _tip_parts(problem: Problem, at_fit: Fitted, fit: RobustFit) -> tuple[float, float]:
    """Spread of the tip's residuals inside and across the image, mm."""
    to_image = (problem.recording.A[:, :3, :3] @ fit.estimate.R_X).transpose(0, 2, 1)[fit.tip_kept]
    r = (to_image @ at_fit.residuals[fit.tip_kept, :3, None])[:, :, 0]
    J = to_image @ at_fit.jacobian[fit.tip_kept, :3]
    sigma = to_image @ at_fit.sigma[fit.tip_kept, :3, :3] @ to_image.transpose(0, 2, 1)
    taken = ((J @ at_fit.covariance) * J).sum(axis=2) / np.diagonal(sigma, axis1=1, axis2=2)
    return _two_parts((r**2).sum(axis=0), len(r) - taken.sum(axis=0))


def _direction_part(at_fit: Fitted, fit: RobustFit, column: int, spread: Floats) -> float:
    """Size of one of the direction's two residuals, rad: the factor of its spread (n,), whose mean square is 1."""
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


STEPS = 12
"""Steps of the parts' sizes between two fits, by likelihood; each comes within a few percent in half as many."""


def by_likelihood(problem: Problem, fit: RobustFit) -> ResidualSpreads:
    """The parts' sizes at a fit, by restricted maximum likelihood."""
    declared = not isinstance(problem.noise, Spread)
    found = ResidualSpreads(problem.noise if isinstance(problem.noise, Spread) else UNWEIGHTED, problem.lean_rad)
    for _ in range(STEPS):
        problem = problem._replace(noise=problem.noise if declared else found.spread, lean_rad=found.lean_rad)
        at_fit = weighed(problem, fit)
        found = _step(problem, fit, at_fit, found)
    return found


LEAST_PART_FREEDOM = 3.0
"""Residuals minus unknowns of one part of the tip's noise below which both parts are found together."""

LEAST_PART_RAD = 1e-6
"""No direction is measured better, and none leans less."""


def _step(problem: Problem, fit: RobustFit, at_fit: Fitted, found: ResidualSpreads) -> ResidualSpreads:
    """Each part times the root of its residuals over their expectation."""
    W = at_fit.whitener
    own = W.transpose(0, 2, 1) @ W  # C_i^-1
    q = own @ at_fit.residuals[:, :, None]  # P r at the fit
    pulled = own @ at_fit.jacobian
    E = own - pulled @ at_fit.covariance @ pulled.transpose(0, 2, 1)  # diagonal blocks of P
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


def _moved_tip_parts(spread: Spread, inside: tuple[float, float], across: tuple[float, float]) -> tuple[float, float]:
    if min(inside[1] * spread.inside_mm**2, across[1] * spread.across_mm**2) < LEAST_PART_FREEDOM:
        both = _growth((inside[0] + across[0], inside[1] + across[1]))  # too few residuals to part them
        return max(spread.inside_mm * both, LEAST_MM), max(spread.inside_mm * both, LEAST_MM)
    sizes = spread.inside_mm * _growth(inside), spread.across_mm * _growth(across)
    least = max(*sizes, LEAST_MM) / WIDEST_RATIO
    return max(sizes[0], least), max(sizes[1], least)


def _growth(sides: tuple[float, float]) -> float:
    return float(np.sqrt(sides[0] / max(sides[1], 1e-300)))  # of a deviation: variances grow by the ratio


class SmallSample(NamedTuple):
    """The confidence region of all p parameters where parts of the noise were found."""

    covariance: Floats
    """Shape (p, p), with the uncertainty of the noise in it."""
    freedom: float
    """Degrees of freedom of Fisher's F's denominator."""
    factor: float
    """What e^T C^-1 e / p is multiplied by to follow that F."""

    def limit(self, level: float) -> float:
        """Largest e^T C^-1 e inside the region."""
        p = len(self.covariance)
        return float(p * f.ppf(level, p, self.freedom) / self.factor)


def small_sample(problem: Problem, fit: RobustFit) -> SmallSample | None:
    """Kenward's and Roger's region at a fit; None where no part of the noise was found."""
    D = structures(problem, fit)
    if not D:
        return None
    at_fit = weighed(problem, fit)
    p = len(problem.active)
    own = _block_diagonal(at_fit.whitener.transpose(0, 2, 1) @ at_fit.whitener)
    slopes = at_fit.jacobian.reshape(len(own), -1)
    J, N = slopes[:, :p], slopes[:, p:]
    inner = np.linalg.inv(np.eye(N.shape[1]) + N.T @ own @ N)
    V = own - own @ N @ inner @ N.T @ own  # Woodbury: inverse of Omega + N N^T
    return _kenward_roger(V, J, at_fit.covariance[:p, :p], [_block_diagonal(part) for part in D.values()])


def _block_diagonal(blocks: Floats) -> Floats:
    n, k, _ = blocks.shape
    full = np.zeros((n, k, n, k))
    full[np.arange(n), :, np.arange(n)] = blocks
    return full.reshape(n * k, n * k)


def _kenward_roger(V: Floats, J: Floats, C: Floats, parts: list[Floats]) -> SmallSample:
    """The paper's section 3, in its letters: V = Sigma^-1, C = Phi, D_i = dSigma / dv_i."""
    VJ = V @ J
    P = V - VJ @ C @ VJ.T  # projection off the unknowns
    PD, VD = [P @ D for D in parts], [V @ D for D in parts]
    W = np.linalg.inv(0.5 * np.array([[np.sum(a * b.T) for b in PD] for a in PD]))  # Var(v)
    Pi = [-VJ.T @ D @ VJ for D in parts]
    pairs = [(i, j) for i in range(len(parts)) for j in range(len(parts))]
    CP = [C @ one for one in Pi]
    A1 = sum(W[i, j] * np.trace(CP[i]) * np.trace(CP[j]) for i, j in pairs)
    A2 = sum(W[i, j] * np.sum(CP[i] * CP[j].T) for i, j in pairs)
    excess = sum(W[i, j] * (VJ.T @ parts[i] @ VD[j] @ VJ - Pi[i] @ C @ Pi[j]) for i, j in pairs)
    size = len(C)
    B = (A1 + 6 * A2) / (2 * size)
    g = ((size + 1) * A1 - (size + 4) * A2) / ((size + 2) * A2)
    below = 3 * size + 2 * (1 - g)
    c1, c2, c3 = g / below, (size - g) / below, (size + 2 - g) / below
    mean = 1.0 / (1.0 - A2 / size)
    variance = 2.0 / size * (1 + c1 * B) / ((1 - c2 * B) ** 2 * (1 - c3 * B))
    freedom = 4 + (size + 2) / (size * variance / (2 * mean**2) - 1)
    adjusted = C + C @ (excess + excess.T) @ C
    return SmallSample(0.5 * (adjusted + adjusted.T), float(freedom), float(freedom / (mean * (freedom - 2))))
