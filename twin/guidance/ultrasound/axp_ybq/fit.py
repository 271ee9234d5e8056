"""The fit: weighted least squares (Gauss-Newton on the rotations' tangent space), outliers, and the noise it shows.

`solve` is its list of stages. The equation and its linearisation are those of `equation.py`.

Single wrong poses do not bend it:
1. Fit all. If no studentised residual stands out, that is the answer, at full efficiency.
2. Otherwise weigh residuals down as they grow, first by Huber's weights, then by Tukey's; the scale from the median.
3. Set aside what stands out there, fit the rest by plain (weighted) least squares, and look once more at all poses.

Parts of the noise that are not given: C = sum_k v_k D_k + what is declared. The likelihood demands of every part that

    r^T P D_k P r = tr(P D_k),   P = C^-1 - C^-1 J (J^T C^-1 J)^-1 J^T C^-1,

and the ratio of the two sides is the factor by which v_k is moved. The region where v was found from few residuals:
Kenward and Roger, "Small sample inference for fixed effects from restricted maximum likelihood", Biometrics 53(3),
1997: an F whose freedom comes from the uncertainty of v, Var(v)^-1 = tr(P D_k P D_l) / 2, and a covariance with that
uncertainty in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv
from scipy.stats import f

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import Finding, InputError, Severity, refuse
from puncture_twin.planning.geometry.gauss_newton import Fit, Whitening, gauss_newton, lacking, whitener
from puncture_twin.twin.guidance.ultrasound.axp_ybq.equation import (
    DIRECTION,
    HALF_NORMAL,
    SCALE,
    Estimate,
    Problem,
    SeenDirection,
    Spread,
    WeightedProblem,
    directions_image,
    linearised_tip,
    needle_direction,
    needle_in_image,
    tip_residuals,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.observability import Observability, require_observable


class RobustFit(NamedTuple):
    """A fit, and the poses whose tip and whose direction it used, each of shape (n,)."""

    estimate: Estimate
    tip_used: Bools  # shape (n,): the tip of this pose was used
    direction_used: Bools  # shape (n,): its direction was used
    iterations: int


Weights = Floats | Bools
MAX_STEPS = 50
"""A good start needs five; what has not settled after fifty does not."""
SMALL_STEP = 1e-7
"""A step whose largest part (rad, 100 mm) is smaller ends the refinement: it is off by less than 1e-5 mm."""


def residual_weights(problem: Problem, tip_weights: Weights, direction_weights: Weights) -> Floats:
    """One weight per residual, shape (n, k), from one per pose for tip and direction (a flag counts as 1 or 0)."""
    columns = [tip_weights] * 3 + [direction_weights] * (2 if problem.with_direction else 0)
    return np.column_stack(columns).astype(np.float64)


def refine(
    problem: Problem, start: Estimate, tip_weights: Weights, direction_weights: Weights, *, max_steps: int = MAX_STEPS
) -> Fit[Estimate]:
    """The estimate of least weighted squares near a start; the pose covariances follow the estimate.

    Weights are one per pose for its tip and for its direction, (n,); a flag counts as 1 or 0.
    """
    weighted = WeightedProblem(problem, residual_weights(problem, tip_weights, direction_weights))
    return gauss_newton(
        start,
        weighted.linearised,
        weighted.moved,
        lambda _, step: bool(np.abs(step).max() < SMALL_STEP),
        max_steps,
    )


class Fitted(NamedTuple):
    """A problem linearised at its fit; m errors that the poses share stand behind the p free parameters as unknowns."""

    residuals: Floats  # shape (n, k), without what the shared errors explain
    jacobian: Floats  # shape (n, k, p + m), shared errors in standard deviations
    sigma: Floats  # shape (n, k, k), expected covariance of each pose's own noise
    white: Floats  # shape (n, k), residuals of the poses that were used over their spread
    covariance: Floats
    shared: Floats  # shape (m,), the shared errors' posterior mean in standard deviations
    whitener: Floats  # shape (n, k, k), of sigma

    @property
    def chi_squared(self) -> float:
        """r^T C^-1 r: the residuals' squares, and what the shared errors cost."""
        return float(np.sum(self.white**2) + self.shared @ self.shared)


def weighed(problem: Problem, fit: RobustFit) -> Fitted:
    """A problem linearised at its fit, with the poses that made it."""
    weights = residual_weights(problem, fit.tip_used, fit.direction_used)
    r, J, sigma, N = problem.linear_model(fit.estimate)
    W, p = whitener(sigma, weights), J.shape[2]
    if N is not None:
        J = np.concatenate([J, N], axis=2)
    slopes = (W @ J).reshape(-1, J.shape[2])
    information = slopes.T @ slopes
    information[p:, p:] += np.eye(J.shape[2] - p)
    C = np.asarray(np.linalg.pinv(information, hermitian=True), dtype=np.float64)
    shared = np.zeros(0)
    if N is not None:
        shared = -C[p:] @ (slopes.T @ (W @ r[:, :, None]).reshape(-1))
        r = r + N @ shared
    return Fitted(r, J, sigma, (W @ r[:, :, None])[:, :, 0], C, shared, W)


def plain_fit(problem: Problem, start: Estimate) -> RobustFit:
    """Least squares over all poses."""
    every = np.ones(len(problem.recording), dtype=bool)
    fit = refine(problem, start, every, every)
    return RobustFit(fit.estimate, every, every, fit.iterations)


LEAST_MM = 1e-9
"""Below this there is no noise, only rounding."""


def median_spread(problem: Problem, estimate: Estimate) -> Spread:
    """The tip's spread inside and across the image, from medians: outliers hardly move it."""
    to_image = (problem.recording.A[:, :3, :3] @ estimate.R_X).transpose(0, 2, 1)
    r = np.abs(to_image @ tip_residuals(estimate, problem.recording)[:, :, None])[:, :, 0]
    inside, across = (max(float(np.median(part)) / HALF_NORMAL, LEAST_MM) for part in (r[:, :2], r[:, 2]))
    return Spread(max(inside, across / 3), max(across, inside / 3), 1.0)


def robust_fit(problem: Problem, start: Estimate) -> RobustFit:
    """Least squares over the poses that agree.

    Raises:
        InputError: More than half of the poses disagree.
    """
    fit = plain_fit(problem, start)
    if isinstance(problem.noise, Spread):
        problem = problem._replace(noise=median_spread(problem, fit.estimate))
    if all(part.all() for part in agreeing(problem, fit, alarm=True)):
        return fit
    return settled(problem, reweighted(problem, fit))


LOOKS = 5
"""How often poses may change sides before the last split is kept."""
LEAST_KEPT = 0.5
"""If more than half of the poses disagree, nobody can say which half is right."""


def settled(problem: Problem, fit: RobustFit) -> RobustFit:
    """Fit the poses that are used, check all poses against the fit, and repeat until none changes sides.

    The problem may have grown since the fit (directions, another spread).

    Raises:
        InputError: More than half of the poses disagree.
    """
    n, agree = len(problem.recording), (fit.tip_used, fit.direction_used)
    for _ in range(LOOKS):
        if agree[0].sum() < max(LEAST_KEPT * n, len(problem.active) / 3 + 1):
            what = f"only {int(agree[0].sum())} of {n} poses agree with each other"
            refuse(what, "recording", "a recording in which most tips are right", "poses_disagree")
        again = refine(problem, fit.estimate, *agree)
        fit = RobustFit(again.estimate, *agree, fit.iterations + again.iterations)
        agree = agreeing(problem, fit)
        if all(np.array_equal(new, old) for new, old in zip(agree, fit[1:3], strict=True)):
            break
    return fit


HUBER_STEPS, TUKEY_STEPS = 6, 12
HUBER, TUKEY = (float(np.sqrt(2 * gammaincinv(3 / 2, level))) for level in (0.8, 0.9999))
"""Where the weights begin to fall, and where they reach zero, in standard deviations."""
STILL_USED = 0.05
"""Tukey's weight from which on a pose counts as one that agrees."""


def reweighted(problem: Problem, fit: RobustFit) -> RobustFit:
    """Huber, then Tukey; every pose still counts as used, with a weight below 1."""
    estimate, weights = fit.estimate, [np.ones(len(problem.recording))] * 2
    for step in range(HUBER_STEPS + TUKEY_STEPS):
        r, _, sigma, shared = problem.linear_model(estimate)
        if shared is not None:
            sigma = sigma + shared @ shared.transpose(0, 2, 1)
        for k, block in enumerate(blocks(problem)):
            parts = r[:, block.rows], sigma[:, block.rows, block.rows]
            size = np.sqrt(standardised(*parts, _axes(problem, estimate, block), block, weights[k] >= 0.0))
            falls = np.minimum(1.0, HUBER / np.maximum(size, 1e-12))
            weights[k] = falls if step < HUBER_STEPS else np.maximum(1 - (size / TUKEY) ** 2, 0.0) ** 2
        estimate = refine(problem, estimate, *weights, max_steps=1).estimate
    steps = fit.iterations + HUBER_STEPS + TUKEY_STEPS
    return RobustFit(estimate, weights[0] > STILL_USED, weights[1] > STILL_USED, steps)


FALSE_ALARMS = 0.01
"""Chance that a recording without outliers loses a pose."""
ROUNDING = 1e-6
"""Mm, and rad: residuals of this size are rounding, and no outliers."""
ALARM_FRACTION = 0.6
"""Fraction of the spread that is believed while outliers may be in it: a false alarm costs time, not accuracy."""


def agreeing(problem: Problem, fit: RobustFit, *, alarm: bool = False) -> tuple[Bools, Bools]:
    """Tips and directions that agree with the fit, given how far each one pulled it.

    ``alarm`` only asks whether a closer look is due, after a fit of all poses, whose outliers widen the spread.
    """
    at_fit = weighed(problem, fit)
    pulled = at_fit.jacobian @ at_fit.covariance @ at_fit.jacobian.transpose(0, 2, 1)
    agree = []
    for block, used in zip(blocks(problem), (fit.tip_used, fit.direction_used), strict=False):
        own, r = at_fit.sigma[:, block.rows, block.rows], at_fit.residuals[:, block.rows]
        S = own + np.where(used, -1.0, 1.0)[:, None, None] * pulled[:, block.rows, block.rows]
        # what rounding and a pose of nearly full leverage leave of it, lifted to a thousandth of its own noise
        S = S + 1e-3 * np.trace(own, axis1=1, axis2=2)[:, None, None] / own.shape[1] * np.eye(own.shape[1])
        if alarm:
            size = squared_size(r, S)
            agree.append(size <= block.limit * scale(size[used], block, ALARM_FRACTION))
        else:
            agree.append(standardised(r, S, _axes(problem, fit.estimate, block), block, used) <= block.limit)
    return agree[0], agree[1] & facing(problem, fit.estimate) if problem.with_direction else fit.direction_used


def facing(problem: Problem, estimate: Estimate) -> Bools:
    """Poses whose measured direction points along V at all, shape (n,): a reversed one has no residual."""
    recording = problem.recording
    m = needle_in_image(estimate, recording) @ estimate.V
    return np.asarray(np.einsum("ni,ni->n", m, directions_image(recording, estimate)) > 0)


class Block(NamedTuple):
    """One kind of residual."""

    rows: slice
    median: float
    limit: float  # of the squared studentised one, for a recording of this size
    least: float  # variance over the expected one: stated noise is present; less than rounding is not


def blocks(problem: Problem) -> list[Block]:
    """The tip's three residuals, and the direction's one inside the image: across it little is claimed."""
    quantile, noise = 1 - FALSE_ALARMS / len(problem.recording), problem.noise
    least = least_turn = 1.0
    if isinstance(noise, Spread):
        least, least_turn = (ROUNDING / noise.inside_mm) ** 2, (ROUNDING / noise.direction_rad) ** 2
    kinds = [Block(slice(0, 3), _chi_squared(0.5, 3), _chi_squared(quantile, 3), least)]
    if problem.with_direction:
        kinds.append(Block(slice(3, 4), _chi_squared(0.5, 1), _chi_squared(quantile, 1), least_turn))
    return kinds


def _chi_squared(level: float, freedom: int) -> float:
    """Quantile of the chi-squared distribution (scipy.stats takes a hundred times as long)."""
    return float(2 * gammaincinv(freedom / 2, level))


def scale(squared: Floats, block: Block, fraction: float = 1.0) -> float:
    """Variance over the expected one, from the median of the squared sizes."""
    return max(fraction * float(np.median(squared)) / block.median, block.least)


def standardised(r: Floats, S: Floats, axes: Floats, block: Block, used: Bools) -> Floats:
    """Squared size (n,) of residuals (n, k) over their spread S (n, k, k): chi-squared where the noise is as S says.

    S says how large the noise is against itself; how large at all, the median says of those that are used. Where the
    medians along single axes, columns (n, k, k) in which the parts are independent, say more, those count: a tip that
    is found to .1 mm along the shaft and to .01 mm across it, by exact poses, has residuals of one dimension, whose
    largest are further from their median than those of three dimensions.
    """
    to_axes = axes.transpose(0, 2, 1)
    r, S = (to_axes @ r[:, :, None])[:, :, 0], to_axes @ S @ axes
    pooled = scale(squared_size(r, S)[used], block)
    single = np.median((r**2 / np.diagonal(S, axis1=1, axis2=2))[used], axis=0) / _chi_squared(0.5, 1)
    return np.asarray(squared_size(r / np.sqrt(np.maximum(1.0, single / pooled)), S) / pooled)


def _axes(problem: Problem, estimate: Estimate, block: Block) -> Floats:
    """Along the shaft, across it and across the image for tips, in base1; the image's own axes without directions."""
    recording = problem.recording
    if block.rows.start:
        return np.ones((len(recording), 1, 1))
    local = np.tile(np.eye(3), (len(recording), 1, 1))
    if recording.v is not None:
        along = recording.v[:, :2] / np.linalg.norm(recording.v[:, :2], axis=1)[:, None]
        local[:, :2, 0], local[:, :2, 1] = along, along[:, ::-1] * [-1.0, 1.0]
    return np.asarray(recording.A[:, :3, :3] @ estimate.R_X @ local)


def squared_size(r: Floats, S: Floats) -> Floats:
    """r^T S^-1 r of each pose, shape (n,), of residuals (n, k) whose covariance is S (n, k, k)."""
    return np.asarray(np.einsum("ni,ni->n", r, np.linalg.solve(S, r[:, :, None])[:, :, 0]))


SPREAD_ROUNDS = 2
"""How often the residuals' spread is found and the fit repeated with it; it settles to a few percent in two."""


def refitted(problem: Problem, fit: RobustFit, seen: SeenDirection) -> tuple[Problem, RobustFit]:
    """Fit again with the directions, and with the spread that the residuals themselves show where no noise is given.

    The problem has the directions where they take part, the fit is of the tips alone, ``seen`` the direction at that
    fit.
    """
    if isinstance(problem.noise, Spread):
        tips = problem._replace(active=problem.active[problem.active < DIRECTION.start])
        problem = problem._replace(noise=with_spreads(tips, fit).noise._replace(direction_rad=seen.spread_rad))
    for _ in range(SPREAD_ROUNDS):
        fit = settled(problem, fit)
        problem = with_spreads(problem, fit)
    return problem, fit


STEPS = 12
"""Steps of the parts' sizes between two fits, by likelihood; each comes within a few percent in half as many."""
LEAST_FREEDOM = 15
"""Residuals minus unknowns below which inside and across are not distinguished: their ratio would be chance."""
LEAST_RAD = 1e-9
"""Least deviation of directions that is estimated, rad: it keeps weights finite."""
WIDEST_RATIO = 30.0
"""Inside and across the image are not taken to differ by more."""


def with_spreads(problem: Problem, fit: RobustFit) -> Problem:
    """The problem with its noise, where none is stated, and the needle's lean as the residuals show them.

    One step of variance component estimation, squares of residuals over what the fit left free of them, whose fixed
    point is the restricted maximum likelihood estimate (Förstner 1979); with errors of the arms it is gone to at once.
    """
    if problem.arms is not None:
        for _ in range(STEPS):
            problem = _likelier(problem, fit)
        return problem
    at_fit, noise, lean, turn = weighed(problem, fit), problem.noise, problem.lean_rad, 1.0
    if problem.with_direction:
        turn = _direction_part(at_fit, fit, 3, problem.recording.direction_spread)
        lean = _direction_part(at_fit, fit, 4, np.ones(len(problem.recording)))
        arms = 0.0 if isinstance(noise, Spread) else 2 * noise.robot_rad**2
        lean = float(np.sqrt(max(lean**2 - arms, arms / 100, LEAST_RAD**2)))
    if isinstance(noise, Spread):
        noise = Spread(*_tip_parts(problem, at_fit, fit), turn)
    return problem._replace(noise=noise, lean_rad=lean)


def _tip_parts(problem: Problem, at_fit: Fitted, fit: RobustFit) -> tuple[float, float]:
    """Spread of the tip's residuals inside and across the image, mm."""
    to_image = (problem.recording.A[:, :3, :3] @ fit.estimate.R_X).transpose(0, 2, 1)[fit.tip_used]
    r = (to_image @ at_fit.residuals[fit.tip_used, :3, None])[:, :, 0]
    J = to_image @ at_fit.jacobian[fit.tip_used, :3]
    sigma = to_image @ at_fit.sigma[fit.tip_used, :3, :3] @ to_image.transpose(0, 2, 1)
    taken = ((J @ at_fit.covariance) * J).sum(axis=2) / np.diagonal(sigma, axis1=1, axis2=2)
    squares, freedom = (r**2).sum(axis=0), len(r) - taken.sum(axis=0)
    if freedom.sum() < LEAST_FREEDOM or freedom[2] < LEAST_FREEDOM / 5:
        pooled = max(float(np.sqrt(squares.sum() / max(freedom.sum(), 1.0))), LEAST_MM)
        return pooled, pooled
    return _within_ratio(float(np.sqrt(squares[:2].sum() / freedom[:2].sum())), float(np.sqrt(squares[2] / freedom[2])))


def _within_ratio(inside: float, across: float) -> tuple[float, float]:
    least = max(inside, across, LEAST_MM) / WIDEST_RATIO
    return max(inside, least), max(across, least)


def _direction_part(at_fit: Fitted, fit: RobustFit, column: int, spread: Floats) -> float:
    """Size of one of the direction's two residuals, rad: the factor of its spread (n,), whose mean square is 1."""
    used = fit.direction_used
    r, J, expected = at_fit.residuals[used, column], at_fit.jacobian[used, column], at_fit.sigma[used, column, column]
    freedom = len(r) - float((((J @ at_fit.covariance) * J).sum(axis=1) / expected).sum())
    return max(float(np.sqrt(np.sum((r / spread[used]) ** 2) / max(freedom, 1.0))), LEAST_RAD)


LEAST_PART_FREEDOM = 3.0
"""Residuals minus unknowns of one part of the tip's noise below which both parts are found together."""
LEAST_PART_RAD = 1e-6
"""No direction is measured better, and none leans less."""


def _likelier(problem: Problem, fit: RobustFit) -> Problem:
    """Each part times the root of its residuals over their expectation."""
    at_fit, noise = weighed(problem, fit), problem.noise
    own = at_fit.whitener.transpose(0, 2, 1) @ at_fit.whitener  # C_i^-1
    q = own @ at_fit.residuals[:, :, None]  # P r at the fit
    pulled = own @ at_fit.jacobian
    E = own - pulled @ at_fit.covariance @ pulled.transpose(0, 2, 1)  # diagonal blocks of P
    sides = {
        name: (float((q.transpose(0, 2, 1) @ D @ q).sum()), float(np.einsum("nij,nji->", D, E)))
        for name, D in structures(problem, fit).items()
    }
    if isinstance(noise, Spread):
        turn = max(noise.direction_rad * _growth(sides["turn"]), LEAST_PART_RAD) if "turn" in sides else None
        parts = _moved_tip_parts(noise, sides["inside"], sides["across"])
        noise = Spread(*parts, noise.direction_rad if turn is None else turn)
    if "lean" in sides:
        problem = problem._replace(lean_rad=max(problem.lean_rad * _growth(sides["lean"]), LEAST_PART_RAD))
    return problem._replace(noise=noise)


def structures(problem: Problem, fit: RobustFit) -> dict[str, Floats]:
    """Covariance of the residuals (n, k, k) that each found part has at size 1, by its name."""
    image = problem.recording.A[:, :3, :3] @ fit.estimate.R_X
    n, k = len(problem.recording), 5 if problem.with_direction else 3
    parts: dict[str, Floats] = {}
    if isinstance(problem.noise, Spread):
        for name, axes in (("inside", image[:, :, :2]), ("across", image[:, :, 2:])):
            parts[name] = np.zeros((n, k, k))
            parts[name][:, :3, :3] = axes @ axes.transpose(0, 2, 1)
    if problem.with_direction:
        rows = {"lean": 4} if not parts else {"turn": 3, "lean": 4}
        for name, row in rows.items():
            parts[name] = np.zeros((n, k, k))
            parts[name][:, row, row] = problem.recording.direction_spread**2 if name == "turn" else 1.0
    return parts


def _moved_tip_parts(spread: Spread, inside: tuple[float, float], across: tuple[float, float]) -> tuple[float, float]:
    if min(inside[1] * spread.inside_mm**2, across[1] * spread.across_mm**2) < LEAST_PART_FREEDOM:
        both = _growth((inside[0] + across[0], inside[1] + across[1]))  # too few residuals to part them
        return max(spread.inside_mm * both, LEAST_MM), max(spread.inside_mm * both, LEAST_MM)
    return _within_ratio(spread.inside_mm * _growth(inside), spread.across_mm * _growth(across))


def _growth(sides: tuple[float, float]) -> float:
    return float(np.sqrt(sides[0] / max(sides[1], 1e-300)))  # of a deviation: variances grow by the ratio


class SmallSample(NamedTuple):
    """The confidence region of all p parameters where parts of the noise were found, with its uncertainty in it."""

    covariance: Floats  # shape (p, p), with the uncertainty of the noise in it
    freedom: float  # of Fisher's F's denominator
    factor: float  # what e^T C^-1 e / p is multiplied by to follow that F

    def limit(self, level: float) -> float:
        """Largest e^T C^-1 e inside the region."""
        p = len(self.covariance)
        return float(p * f.ppf(level, p, self.freedom) / self.factor)


def small_sample(problem: Problem, fit: RobustFit) -> SmallSample | None:
    """Kenward's and Roger's region at a fit; None where no part of the noise was found."""
    D = structures(problem, fit)
    if not D:
        return None
    at_fit, p = weighed(problem, fit), len(problem.active)
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


SIGNIFICANT = 0.01
"""A recording without errors of the image is said to have them once in a hundred."""
CLEAR = 3.0
"""An error so many standard deviations from zero is named with the largest one."""
ERRORS = {
    "scale_u": "mm per unit of P along u: {:.3f} times",
    "scale_v": "along v: {:.3f} times",
    "skew": "skew {:+.2f} deg",
    "turn": "v rotated {:+.2f} deg",
}


class ImageErrors(NamedTuple):
    """The errors of the image that the residuals show.

    A tip that is read as p lies at S p, S = [[1 + a, k], [0, 1 + b]]: mm per unit of P that are off, axes not square.
    A direction read as v points along S v, rotated by w. The residuals' derivatives by (a, b, k, w) join the Jacobian,
    and the F-test of all of them together says whether residuals that are only noise would be so well explained: once
    in a hundred recordings. The calibration does not use them; what they leave at the tips counts in its error.
    """

    names: tuple[str, ...]  # of those that were tested, keys of `ERRORS`
    found: Floats  # a, b, k (per mm) and w (rad), with their standard deviations; shape (k,)
    sd: Floats
    probability: float  # chance of residuals so well explained where there are none: F(k, freedom)
    rms_mm: float  # what they leave at the recorded tips, whatever the calibration does to make up for them

    @property
    def significant(self) -> bool:
        """True where the test finds errors of the image."""
        return self.probability < SIGNIFICANT

    def finding(self) -> Finding:
        """One sentence: which errors, how large, how sure, and their effect at the tips."""
        size = np.abs(self.found / self.sd)
        shown = [
            ERRORS[name].format(1 + value if name.startswith("scale") else np.degrees(value))
            for name, value, over in zip(self.names, self.found, size, strict=True)
            if over >= min(CLEAR, size.max())
        ]
        text = (
            f"the residuals are more than noise: they fit better with {', '.join(shown)} (F test of "
            f"{len(self.names)} errors of the image, p {self.probability:.2g}), which leaves {self.rms_mm:.2f} mm "
            "(rms) at the tips; the calibration does not use this: columns P_u_px, P_v_px let it estimate mm per pixel"
        )
        numbers = dict(zip(self.names, self.found.tolist(), strict=True))
        return Finding("image_errs", Severity.WARNING, text, {**numbers, "p": self.probability, "rms_mm": self.rms_mm})


def image_errors(problem: Problem, fit: RobustFit) -> ImageErrors | None:
    """The errors of the image at a fit; None where the poses cannot show them."""
    weights = residual_weights(problem, fit.tip_used, fit.direction_used)
    model = problem.linear_model(fit.estimate)
    free = SCALE.start not in problem.active
    wanted = np.array([free, free, True, problem.with_direction])
    recording, estimate = problem.recording, fit.estimate
    tip = linearised_tip(estimate, recording).jacobian[:, :, SCALE] * estimate.scale
    skewed = -(recording.A[:, :3, :3] @ estimate.R_X)[:, :, :1] * (recording.P[:, None, 1:2] * estimate.scale[1])
    columns = np.concatenate([tip, skewed, np.zeros_like(skewed)], axis=2)  # the residuals' slopes by a, b, k and w
    if problem.with_direction:
        c, s, _ = directions_image(recording, estimate).T
        by_turn = np.stack([-c * s, c * s, -(s**2), np.ones(len(recording))], axis=1)
        rows = np.stack([-by_turn, np.zeros_like(by_turn)], axis=1)
        columns = np.concatenate([columns, rows], axis=1)
    columns = columns[:, :, wanted]
    whitening = Whitening.of(model.sigma, model.shared, weights)
    A, more = whitening.slopes(model.jacobian), whitening.slopes(columns)
    errors = lacking(-whitening.residuals(model.residuals), A, more, count=int(weights.sum()))
    if errors is None:
        return None
    pulled = np.linalg.lstsq(A, more @ errors.found, rcond=None)[0]
    left = (columns @ errors.found - model.jacobian @ pulled)[fit.tip_used, :3]
    rms = float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
    return ImageErrors(tuple(np.array(list(ERRORS))[wanted].tolist()), errors.found, errors.sd, errors.probability, rms)


class Solution(NamedTuple):
    """Result of `solve`."""

    problem: Problem  # with the noise that the residuals show
    fit: RobustFit
    observability: Observability
    seen: SeenDirection  # before the directions took part
    image: ImageErrors | None  # None where the poses cannot show errors of the image


def solve(problem: Problem, start: Estimate, *, direction: bool) -> Solution:
    """Fit the tips, require that all unknowns are observable, then fit again with directions and estimated noise."""
    recording = problem.recording
    fit = robust_fit(problem, start)
    try:
        seen = needle_direction(fit.estimate, recording, fit.tip_used)
    except InputError:  # directions say little of poses that show too little
        require_observable(fit.estimate, recording.subset(fit.tip_used), problem.active)
        raise
    fit = fit._replace(estimate=fit.estimate._replace(V=seen.V), direction_used=seen.agrees)
    observability = require_observable(fit.estimate, recording.subset(fit.tip_used), problem.active)
    if direction:
        active = np.append(problem.active, [DIRECTION.start, DIRECTION.start + 1])
        problem = problem._replace(active=active, lean_rad=seen.lean_rad)
    if isinstance(problem.noise, Spread) or problem.with_direction:
        before = fit.tip_used
        problem, fit = refitted(problem, fit, seen)
        if not np.array_equal(before, fit.tip_used):
            observability = require_observable(fit.estimate, recording.subset(fit.tip_used), problem.active)
    return Solution(problem, fit, observability, seen, image_errors(problem, fit))
