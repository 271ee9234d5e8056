"""The squared studentised residual of each pose, and the limit above which it stands out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import Problem, Spread

FALSE_ALARMS = 0.01
"""Chance that a recording without outliers loses a pose."""

ROUNDING = 1e-6
"""Mm, and rad: residuals of this size are rounding, and none of them stands out."""


class Block(NamedTuple):
    """One kind of residual."""

    rows: slice
    median: float
    limit: float
    """Of the squared studentised residual, for a recording of this size."""
    least: float
    """Variance over the expected one below which it is not believed: told noise is there; less than rounding is not."""


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
    """Variance over the expected one, from the median."""
    return max(fraction * float(np.median(squared)) / block.median, block.least)


def squared_size(r: Floats, S: Floats) -> Floats:
    """r^T S^-1 r of each pose, shape (n,), of residuals (n, k) whose covariance is S (n, k, k)."""
    return np.asarray(np.einsum("ni,ni->n", r, np.linalg.solve(S, r[:, :, None])[:, :, 0]))


def lifted(S: Floats, own: Floats) -> Floats:
    """S with what rounding and a pose of nearly full leverage leave of it lifted to a thousandth of its own noise."""
    least = 1e-3 * np.trace(own, axis1=1, axis2=2)[:, None, None] / own.shape[1] * np.eye(own.shape[1])
    return np.asarray(S + least)
