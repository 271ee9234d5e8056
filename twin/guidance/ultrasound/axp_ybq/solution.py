"""A fit with all that is known about it, and the calibration that is made of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.findings import Finding
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.twin.guidance.ultrasound.axp_ybq.arm_errors import DeclaredArms
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration
from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import SeenDirection, direction_findings
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import DIRECTION, PARAMETERS, T_Q, Estimate, tangent_basis
from puncture_twin.twin.guidance.ultrasound.axp_ybq.image_errors import ImageErrors, image_errors
from puncture_twin.twin.guidance.ultrasound.axp_ybq.noise import SmallSample, small_sample
from puncture_twin.twin.guidance.ultrasound.axp_ybq.observability import Observability
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import Problem, Spread
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.refine import RobustFit, weighed
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals import needle_in_image


class Solution(NamedTuple):
    """A fit with all that is known about it."""

    estimate: Estimate
    active: NDArray[np.int_]
    tip_kept: NDArray[np.bool_]
    image: ImageErrors | None
    findings: tuple[Finding, ...]
    iterations: int
    noise: Noise | Spread
    covariance: Floats
    """Of the free parameters, then of the arms' lasting errors where they are declared, shape (p + m, p + m)."""
    arm_errors: Floats
    """Posterior mean of the arms' lasting errors, in standard deviations, shape (m,): 46, with
    play in both arms 58, and 0 where none are declared."""
    small_sample: SmallSample | None
    residuals: Floats
    noise_ratio: float
    freedom: int
    observability: Observability
    orientations: Floats


def solution_of(problem: Problem, fit: RobustFit, observability: Observability, seen: SeenDirection) -> Solution:
    """What is known at a fit, under the noise that was found or declared."""
    at_fit = weighed(problem, fit)
    count = 3 * int(fit.tip_kept.sum()) + 2 * int(fit.direction_kept.sum()) * problem.with_direction
    freedom = count - len(problem.active)
    region = small_sample(problem, fit) if problem.arms is not None else None
    image = image_errors(problem, fit)
    told = direction_findings(problem.recording.names, fit.tip_kept & ~fit.direction_kept, seen)
    return Solution(
        fit.estimate,
        problem.active,
        fit.tip_kept,
        image,
        told if image is None or not image.doubted else (*told, image.finding()),
        fit.iterations,
        problem.noise,
        at_fit.covariance,
        at_fit.shared,
        region,
        at_fit.residuals[:, :3],
        float(np.sqrt(at_fit.chi_squared / max(freedom, 1))),
        freedom,
        observability,
        needle_in_image(fit.estimate, problem.recording),
    )


def with_length(solution: Solution, bias: float) -> Solution:
    """The solution after t_Q <- t_Q - (V.t_Q - length) V."""
    V, t_Q = solution.estimate.V, solution.estimate.t_Q
    full = np.eye(len(PARAMETERS))
    full[T_Q, T_Q] -= np.outer(V, V)
    full[T_Q, DIRECTION] = -(bias * np.eye(3) + np.outer(V, t_Q)) @ tangent_basis(V)
    change = full[np.ix_(solution.active, solution.active)]
    whole = np.eye(len(solution.covariance))
    whole[: len(change), : len(change)] = change
    region = solution.small_sample
    if region is not None:
        region = region._replace(covariance=change @ region.covariance @ change.T)
    return solution._replace(
        estimate=solution.estimate._replace(t_Q=t_Q - bias * V),
        covariance=np.asarray(whole @ solution.covariance @ whole.T),
        small_sample=region,
    )


def assembled(
    recording: Recording, solution: Solution, bias: float | None, cannot: tuple[str, ...], arms: DeclaredArms | None
) -> Calibration:
    """The calibration of a solution, its arrays read-only.

    Args:
        recording: What it was solved from.
        solution: As solved.
        bias: What was taken off the tip along the shaft, mm; None where the needle's length is not known.
        cannot: What the poses cannot show, one sentence each.
        arms: As declared.
    """
    estimate, kept, p = solution.estimate, solution.tip_kept, len(solution.active)
    return Calibration(
        read_only(pose(estimate.R_X, estimate.t_X)),
        read_only(pose(estimate.R_Y, estimate.t_Y)),
        read_only(estimate.t_Q),
        read_only(estimate.V),
        read_only(estimate.scale),
        read_only(solution.residuals),
        float(np.sqrt(np.mean(np.sum(solution.residuals[kept] ** 2, axis=1)))),
        read_only(1.0 * kept),
        tuple(name for name, used in zip(recording.names, kept, strict=True) if not used),
        solution.image,
        solution.findings,
        solution.iterations,
        solution.observability.ratio,
        read_only(solution.covariance[:p, :p]),
        tuple(PARAMETERS[column] for column in solution.active),
        solution.freedom,
        solution.noise,
        solution.noise_ratio,
        bias,
        read_only(solution.orientations),
        cannot,
        arms,
        read_only(solution.arm_errors),
        read_only(solution.covariance),
        solution.small_sample,
    )
