"""Gauss-Newton on the rotations' tangent space (spec 3, section 2), damped where a step fails."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.gauss_newton import System, gauss_newton
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import LENGTH_MM
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import (
    DIRECTION,
    N_PARAMETERS,
    SCALE,
    T_Q,
    T_X,
    T_Y,
    Estimate,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals import (
    Linearised,
    direction_residuals,
    directions_image,
    linearised_direction,
    linearised_tip,
    tip_residuals,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.weighting import Spread, covariances, whitener

Weights = Floats | NDArray[np.bool_]

MAX_STEPS = 50
"""A good start needs five; what has not settled after fifty does not."""

SMALL_STEP = 1e-7
"""A step whose largest part (rad, 100 mm) is smaller ends the refinement: it is off by less than 1e-5 mm."""


class Problem(NamedTuple):
    """What is to be estimated, from what."""

    recording: Recording
    noise: Noise | Spread
    active: NDArray[np.int_]
    """Which of the 19 parameters are free."""
    lean_rad: float = 0.0
    """How far needles lean out of the slice and still show: all that a direction seen in the image says across it."""

    @property
    def with_direction(self) -> bool:
        """Whether the measured directions take part."""
        return bool(self.active[-1] >= DIRECTION.start)


class Refined(NamedTuple):
    """Where the refinement ended."""

    estimate: Estimate
    iterations: int


def linearise(problem: Problem, estimate: Estimate) -> Linearised:
    """All residuals (n, 3 or 5) and their Jacobian by the free parameters (n, 3 or 5, p)."""
    tip = linearised_tip(estimate, problem.recording)
    if not problem.with_direction:
        return Linearised(tip.residuals, tip.jacobian[:, :, problem.active])
    v_image = directions_image(problem.recording, estimate)
    turn = linearised_direction(estimate, problem.recording, v_image)
    jacobian = np.concatenate([tip.jacobian, turn.jacobian], axis=1)[:, :, problem.active]
    return Linearised(np.concatenate([tip.residuals, turn.residuals], axis=1), jacobian)


def problem_covariances(problem: Problem, estimate: Estimate) -> Floats:
    """The expected covariance of each pose's residuals, shape (n, k, k)."""
    v_image = directions_image(problem.recording, estimate) if problem.with_direction else None
    return covariances(estimate, problem.recording, problem.noise, v_image, problem.lean_rad)


def residual_weights(problem: Problem, tip_weights: Weights, direction_weights: Weights) -> Floats:
    """One weight per residual, shape (n, k), from one per pose for tip and direction (a flag counts as 1 or 0)."""
    columns = [tip_weights] * 3 + [direction_weights] * (2 if problem.with_direction else 0)
    return np.column_stack(columns).astype(np.float64)


def parameter_units(active: NDArray[np.int_], scale: Floats) -> Floats:
    """How large a step of each free parameter is "one": 1 rad, 100 mm, the scale itself."""
    units = np.ones(N_PARAMETERS)
    for part in (T_X, T_Y, T_Q):
        units[part] = LENGTH_MM
    units[SCALE] = scale
    return units[active]


def refine(problem: Problem, start: Estimate, weights: Floats, *, max_steps: int = MAX_STEPS) -> Refined:
    """The estimate of least weighted squares near a start; the pose covariances follow the estimate.

    Args:
        problem: What is estimated.
        start: Such as the closed form's.
        weights: One per residual, shape (n, k).
        max_steps: The most steps taken.
    """

    def linearised(estimate: Estimate) -> System[Estimate]:
        W = whitener(problem_covariances(problem, estimate), weights)
        r, J = linearise(problem, estimate)
        units = parameter_units(problem.active, estimate.scale)

        def cost(near: Estimate) -> float:
            return float(np.sum((W @ _residuals(problem, near)[:, :, None]) ** 2))

        return System((W @ r[:, :, None]).ravel(), (W @ J).reshape(-1, J.shape[2]) * units, cost)

    def moved(estimate: Estimate, step: Floats) -> Estimate:
        return estimate.moved(_full(problem.active, parameter_units(problem.active, estimate.scale) * step))

    def arrived(_: System[Estimate], step: Floats) -> bool:
        return bool(np.abs(step).max() < SMALL_STEP)

    fit = gauss_newton(start, linearised, moved, arrived, max_steps)
    return Refined(fit.estimate, fit.iterations)


def _residuals(problem: Problem, estimate: Estimate) -> Floats:
    tip = tip_residuals(estimate, problem.recording)
    if not problem.with_direction:
        return tip
    v_image = directions_image(problem.recording, estimate)
    return np.concatenate([tip, direction_residuals(estimate, problem.recording, v_image)], axis=1)


def _full(active: NDArray[np.int_], step: Floats) -> Floats:
    full = np.zeros(N_PARAMETERS)
    full[active] = step
    return full
