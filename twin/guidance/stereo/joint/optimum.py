"""The statistically best estimate of ball and target, and the bound that no estimate can beat.

The chain of the paper calibrates, triangulates and maps one after the other, and each step forgets what the others
know: the servo's own images also see the cameras, the arm's commands also see the ball. Here everything that was
measured is adjusted together (`joint_model`). With normal errors and small curvature that attains the
Cramer-Rao bound, which is the same normal matrix taken at the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, NoAnswerError
from puncture_twin.planning.geometry.gauss_newton import System, gauss_newton
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.twin.guidance.stereo.joint.joint_model import Guess, JointModel, Observed, Unknowns, first_unknowns

MAX_ITERATIONS = 30
ARRIVED = 1e-4
"""A step of the adjustment whose every residual changes by less than this standard deviation has arrived."""

UNSETTLED = "the joint adjustment does not settle: a measurement is far off, or the cameras see too little"


class Offset(NamedTuple):
    """Target minus ball, what the servo takes to zero; C."""

    ball_c: Floats
    """Shape (3,), mm."""
    target_c: Floats
    """Shape (3,), mm."""
    ball_covariance: Floats
    """Shape (3, 3), mm^2."""
    target_covariance: Floats
    """Shape (3, 3), mm^2."""
    covariance: Floats
    """Shape (3, 3), mm^2: of target minus ball; less than the sum where both err together."""

    def rms_mm(self) -> float:
        """Root of the mean squared length of the error of target minus ball, mm."""
        return float(np.sqrt(np.trace(self.covariance)))


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The joint estimate, or the truth with its bound.

    Attributes:
        model: The problem.
        unknowns: Their values.
        covariance: Shape (N, N): of the unknowns, by Fisher's information.
        chi2: Sum of the squared residuals.
        freedom: Their number, less that of the unknowns: what chi2 is on average if the declaration holds.
        iterations: Steps taken.
    """

    model: JointModel
    unknowns: Unknowns
    covariance: Floats
    chi2: float
    freedom: int
    iterations: int

    def offset(self, stay: int, target_m: Floats) -> Offset:
        """Ball at one stay and a target of the image, with their covariances.

        Args:
            stay: Which of the stays; -1 is the last.
            target_m: Shape (3,), mm.
        """
        x = self.unknowns
        stay = stay % len(x.balls_c)
        target = apply(self.model.pose_of_head(x), target_m)
        ball_rows = np.zeros((3, len(self.covariance)))
        start = x.span("balls_c").start + 3 * stay
        ball_rows[:, start : start + 3] = np.eye(3)
        target_rows = np.zeros_like(ball_rows)
        target_rows[:, x.span("head")] = self.model.head_slopes(x, target[None])[0]
        ball, aim, both = (
            rows @ self.covariance @ rows.T for rows in (ball_rows, target_rows, target_rows - ball_rows)
        )
        return Offset(x.balls_c[stay], target, ball, aim, both)


def adjust(observed: Observed, guess: Guess, start: Unknowns | None = None) -> Adjusted:
    """The joint estimate of everything, by Gauss-Newton.

    Args:
        observed: What was measured.
        guess: Where poses are counted from; within a few degrees and centimetres.
        start: Unknowns to start from; all errors 0 when None.

    Raises:
        NoAnswerError: It does not settle: some measurement is grossly wrong.
    """
    model = JointModel(observed, guess)
    x = first_unknowns(observed, guess) if start is None else start
    try:
        fit = gauss_newton(x, model.linearised, Unknowns.moved, _arrived, MAX_ITERATIONS)
    except (InputError, np.linalg.LinAlgError, ValueError) as error:  # a camera that cannot be, or what is no number
        raise NoAnswerError(UNSETTLED) from error
    if not (fit.settled and fit.determined):
        raise NoAnswerError(UNSETTLED)
    covariance = np.asarray(np.linalg.inv(fit.system.information), dtype=np.float64)
    chi2 = float(np.sum((fit.system.residuals + fit.system.slopes @ fit.step) ** 2))
    return Adjusted(model, fit.estimate, covariance, chi2, _freedom(fit.system), fit.iterations)


def _freedom(system: System[Unknowns]) -> int:
    rows, unknowns = system.slopes.shape
    return rows - unknowns


def _arrived(system: System[Unknowns], step: Floats) -> bool:
    return bool(np.abs(system.slopes @ step).max() < ARRIVED)


def bound(observed: Observed, guess: Guess, truth: Unknowns) -> Adjusted:
    """The Cramer-Rao bound: Fisher's information at the truth. ``observed`` says who measured what, and how well.

    Args:
        observed: The measurements, of which only the covariances, commands and counts matter.
        guess: What the true poses are counted from.
        truth: The true unknowns.
    """
    model = JointModel(observed, guess)
    system = model.linearised(truth)
    covariance = np.asarray(np.linalg.inv(system.information), dtype=np.float64)
    chi2 = float(system.residuals @ system.residuals)
    return Adjusted(model, truth, covariance, chi2, _freedom(system), 0)
