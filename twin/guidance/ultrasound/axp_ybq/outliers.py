"""Least squares that single wrong poses cannot bend: find them, set them aside, fit the others.

1. Fit all. If no studentised residual stands out, that is the answer, at full efficiency.
2. Otherwise weigh residuals down as they grow, first by Huber's weights, then by Tukey's; the scale from the median.
3. Set aside what stands out there, fit the rest by plain (weighted) least squares, and look once more at all poses.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import facing
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import (
    LinearModel,
    Problem,
    Spread,
    linear_model,
    median_spread,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.refine import RobustFit, refine, weighed


def plain_fit(problem: Problem, start: Estimate) -> RobustFit:
    """Least squares over all poses."""
    ones = np.ones(len(problem.recording))
    fit = refine(problem, start, ones, ones)
    return RobustFit(fit.estimate, ones > 0, ones > 0, fit.iterations)


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

    Args:
        problem: It may have grown since the fit (directions, another spread).

    Raises:
        InputError: More than half of the poses disagree.
    """
    kept = (fit.tip_kept, fit.direction_kept)
    for _ in range(LOOKS):
        _check_enough(problem, kept[0])
        again = refine(problem, fit.estimate, *kept)
        fit = RobustFit(again.estimate, *kept, fit.iterations + again.iterations)
        kept = agreeing(problem, fit)
        if all(np.array_equal(new, old) for new, old in zip(kept, fit[1:3], strict=True)):
            break
    return fit


def _check_enough(problem: Problem, kept: Bools) -> None:
    n, unknowns = len(problem.recording), len(problem.active)
    if kept.sum() < max(LEAST_KEPT * n, unknowns / 3 + 1):
        allowed = "a recording in which most tips are right"
        refuse(f"only {int(kept.sum())} of {n} poses agree with each other", "recording", allowed, "poses_disagree")


HUBER_STEPS, TUKEY_STEPS = 6, 12

HUBER, TUKEY = (float(np.sqrt(2 * gammaincinv(3 / 2, level))) for level in (0.8, 0.9999))
"""Where the weights begin to fall, and where they reach zero, in standard deviations."""

STILL_USED = 0.05
"""Tukey's weight from which on a pose counts as one that agrees."""


def reweighted(problem: Problem, fit: RobustFit) -> RobustFit:
    """Huber, then Tukey; every pose still counts as used, with a weight below 1."""
    estimate, weights = fit.estimate, [np.ones(len(problem.recording))] * 2
    for step in range(HUBER_STEPS + TUKEY_STEPS):
        model = linear_model(problem, estimate)
        r, sigma = model.residuals, _spread_of_one(model)
        for k, block in enumerate(blocks(problem)):
            parts = r[:, block.rows], sigma[:, block.rows, block.rows]
            size = np.sqrt(standardised(*parts, _axes(problem, estimate, block), block, weights[k] >= 0.0))
            falls = np.minimum(1.0, HUBER / np.maximum(size, 1e-12))
            weights[k] = falls if step < HUBER_STEPS else np.maximum(1 - (size / TUKEY) ** 2, 0.0) ** 2
        estimate = refine(problem, estimate, *weights, max_steps=1).estimate
    steps = fit.iterations + HUBER_STEPS + TUKEY_STEPS
    return RobustFit(estimate, weights[0] > STILL_USED, weights[1] > STILL_USED, steps)


def _spread_of_one(model: LinearModel) -> Floats:
    """Covariance of each pose's residuals, whatever the arms' lasting errors are, shape (n, k, k)."""
    if model.shared is None:
        return model.sigma
    return np.asarray(model.sigma + model.shared @ model.shared.transpose(0, 2, 1))


FALSE_ALARMS = 0.01
"""Chance that a recording without outliers loses a pose."""

ROUNDING = 1e-6
"""Mm, and rad: residuals of this size are rounding, and no outliers."""

ALARM_FRACTION = 0.6
"""Fraction of the spread that is believed while outliers may be in it: a false alarm costs time, not accuracy."""


def agreeing(problem: Problem, fit: RobustFit, *, alarm: bool = False) -> tuple[Bools, Bools]:
    """Tips and directions that agree with the fit, given how far each one pulled it.

    Args:
        alarm: Only ask whether a closer look is due, after a fit of all poses, whose outliers widen the spread.
    """
    at_fit = weighed(problem, fit)
    r, J, sigma, C = at_fit.residuals, at_fit.jacobian, at_fit.sigma, at_fit.covariance
    pulled = J @ C @ J.transpose(0, 2, 1)
    kept = []
    for block, used in zip(blocks(problem), (fit.tip_kept, fit.direction_kept), strict=False):
        own = sigma[:, block.rows, block.rows]
        sign = np.where(used, -1.0, 1.0)[:, None, None]
        S = own + sign * pulled[:, block.rows, block.rows]
        parts = r[:, block.rows], lifted(S, own)
        if alarm:
            size = squared_size(*parts)
            kept.append(size <= block.limit * scale(size[used], block, ALARM_FRACTION))
        else:
            kept.append(standardised(*parts, _axes(problem, fit.estimate, block), block, used) <= block.limit)
    return kept[0], kept[1] & facing(fit.estimate, problem.recording) if problem.with_direction else fit.direction_kept


class Block(NamedTuple):
    """One kind of residual."""

    rows: slice
    median: float
    limit: float
    """Limit of the squared studentised residual, for a recording of this size."""
    least: float
    """Variance over the expected one, at least: stated noise is present; less than rounding is not."""


def blocks(problem: Problem) -> list[Block]:
    """The tip's three residuals, and the direction's one inside the image: across it little is claimed."""
    quantile, noise = 1 - FALSE_ALARMS / len(problem.recording), problem.noise
    least = least_turn = 1.0
    if isinstance(noise, Spread):
        least, least_turn = (ROUNDING / noise.inside_mm) ** 2, (ROUNDING / noise.direction_rad) ** 2
    found = [Block(slice(0, 3), _chi_squared(0.5, 3), _chi_squared(quantile, 3), least)]
    if problem.with_direction:
        found.append(Block(slice(3, 4), _chi_squared(0.5, 1), _chi_squared(quantile, 1), least_turn))
    return found


def _chi_squared(level: float, freedom: int) -> float:
    """Quantile of the chi-squared distribution (scipy.stats takes a hundred times as long)."""
    return float(2 * gammaincinv(freedom / 2, level))


def scale(squared: Floats, block: Block, fraction: float = 1.0) -> float:
    """Variance over the expected one, from the median of the squared sizes."""
    return max(fraction * float(np.median(squared)) / block.median, block.least)


def standardised(r: Floats, S: Floats, axes: Floats, block: Block, used: Bools) -> Floats:
    """Squared size of each pose's residuals over their spread, shape (n,): chi-squared where the noise is as S says.

    S says how large the noise is against itself; how large at all, the median says. Where the medians along single axes
    say more, those count: a tip that is found to .1 mm along the shaft and to .01 mm across it, by exact poses, has
    residuals of one dimension, whose largest are further from their median than those of three dimensions.

    Args:
        r: Residuals (n, k).
        S: Their covariance (n, k, k).
        axes: Columns in which their parts are independent, shape (n, k, k).
        block: Which kind they are.
        used: Those whose medians count, shape (n,).
    """
    turned = axes.transpose(0, 2, 1)
    r, S = (turned @ r[:, :, None])[:, :, 0], turned @ S @ axes
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


def lifted(S: Floats, own: Floats) -> Floats:
    """S with what rounding and a pose of nearly full leverage leave of it lifted to a thousandth of its own noise."""
    least = 1e-3 * np.trace(own, axis1=1, axis2=2)[:, None, None] / own.shape[1] * np.eye(own.shape[1])
    return np.asarray(S + least)
