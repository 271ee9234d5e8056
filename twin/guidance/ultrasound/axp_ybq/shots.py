"""A calibration that is updated shot by shot: each further picture adds its information about the calibrated solution.

The unknowns x are the step from the calibration (parameters, and the arms' errors where they are declared), linearised
there once. A shot has the residuals r + H x, their covariance S (3 of the tip, 2 of the direction). With the
information L and its vector l (the information filter: Maybeck, Stochastic Models, 1979, section 5.7)

    L <- L + H^T S^-1 H,    l <- l - H^T S^-1 r,    x = L^-1 l,

so shots commute, and n of them are the batch solution, to linearisation. Before a shot counts, e = r + H x is tested:
e^T (S + H L^-1 H^T)^-1 e is chi-squared where the shot belongs to the others; one that does not fit changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.text import Shown, brief
from puncture_twin.twin.guidance.ultrasound.axp_ybq.arm_errors import arm_errors, without_play
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration, with_length
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import DIRECTION, N_PARAMETERS, PARAMETERS
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import Problem, linear_model
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording

FALSE_ALARM = 1e-3
"""Chance that a shot which belongs to the others is refused."""


class Shot(NamedTuple):
    """What came of one shot."""

    name: str
    used: bool
    chi_squared: float
    """Of its residuals against what calibration, arms and noise let expect."""
    limit: float
    """Beyond it the shot does not fit, and was left out."""


@dataclass(frozen=True, eq=False)
class ShotByShot(Shown):
    """A calibration with the shots since.

    Attributes:
        start: The calibration, where everything is linearised.
        information: Shape (p + m, p + m), of parameters and arms' errors.
        vector: Shape (p + m,): information times the step from the start.
        shots: Every shot, used or not.
    """

    start: Calibration
    information: Floats
    vector: Floats
    shots: tuple[Shot, ...] = ()

    @brief
    def __repr__(self) -> str:
        return f"{len(self.shots)} shots, {sum(not one.used for one in self.shots)} of them did not fit"

    @classmethod
    def of(cls, calibration: Calibration) -> ShotByShot:
        """From a calibration of a recording, with no shot yet.

        Raises:
            InputError: It holds a needle length, so that its tip is not the one that pictures show.
        """
        if calibration.tip_bias_mm is not None:
            what = "a calibration that holds the needle's length"
            refuse(what, "shots", "one without; the length is stated to `calibration`", "conflicting_options")
        C = calibration.joint_covariance
        return cls(calibration, read_only(np.linalg.inv(C)), read_only(np.zeros(len(C))))

    def with_shot(self, pose: Recording) -> ShotByShot:
        """After one more shot, used where it fits; ``shots[-1]`` says so.

        Args:
            pose: One pose, with joints where the start declares arms.

        Raises:
            InputError: More than one pose, or no joints where they are needed.
        """
        if len(pose) != 1:
            refuse(f"{len(pose)} poses", "shot", "one pose", "wrong_shape")
        r, H, S = self._linearised(pose)
        factor = np.linalg.cholesky(self.information)
        back = np.linalg.solve(factor, H.T)  # H L^-1 H^T = back^T back
        e = r + back.T @ np.linalg.solve(factor, self.vector)
        chi_squared = float(e @ np.linalg.solve(S + back.T @ back, e))
        limit = float(2 * gammaincinv(len(r) / 2, 1 - FALSE_ALARM))
        shot = Shot(pose.names[0], chi_squared <= limit, chi_squared, limit)
        if not shot.used:
            return replace(self, shots=(*self.shots, shot))
        pulled = np.linalg.solve(S, H)
        information, vector = self.information + H.T @ pulled, self.vector - pulled.T @ r
        return ShotByShot(self.start, read_only(information), read_only(vector), (*self.shots, shot))

    def _linearised(self, pose: Recording) -> tuple[Floats, Floats, Floats]:
        """Residuals (k,), slopes (k, p + m) and covariance (k, k) of a shot at the start."""
        start = self.start
        errors = None if start.arms is None else arm_errors(start.arms, pose)
        if errors is not None:
            pose = without_play(pose, errors)
        active = np.array([PARAMETERS.index(name) for name in start.parameters])
        if pose.v is None:
            active = active[active < DIRECTION.start]
        r, J, sigma, shared = linear_model(Problem(pose, start.noise, active, start.lean_rad, errors), start.estimate)
        if pose.v is not None and len(r[0]) == 5:  # against the start's directions, not against itself
            longer = (pose.shaft_unit / start.shaft_unit) ** 2
            sigma[0, 3, 3] += (longer - 1.0) * start.noise.direction_rad**2
        slopes = np.zeros((J.shape[1], len(self.vector)))
        slopes[:, : len(active)] = J[0]
        if shared is None:
            return r[0], slopes, sigma[0]
        slopes[:, len(start.parameters) :] = shared[0]
        return r[0] + shared[0] @ start.arm_errors, slopes, sigma[0]

    def calibration(self, *, needle_length_mm: float | None = None) -> Calibration:
        """The calibration after all shots that fit.

        Its residuals, weights and findings are those of the recording at the start.

        Args:
            needle_length_mm: Flange to tip along the shaft; None leaves it open.
        """
        C = np.linalg.inv(self.information)
        step, p = C @ self.vector, len(self.start.parameters)
        full = np.zeros(N_PARAMETERS)
        full[[PARAMETERS.index(name) for name in self.start.parameters]] = step[:p]
        after = self.start.estimate.moved(full)
        X, Y = np.eye(4), np.eye(4)
        X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3] = after.R_X, after.t_X, after.R_Y, after.t_Y
        found = replace(
            self.start,
            X=read_only(X),
            Y=read_only(Y),
            tip_end2=read_only(after.t_Q),
            needle_direction_end2=read_only(after.V),
            scale=read_only(after.scale),
            covariance=read_only(C[:p, :p]),
            joint_covariance=read_only(C),
            arm_errors=read_only(self.start.arm_errors + step[p:]),
            small_sample=None,
        )
        return found if needle_length_mm is None else with_length(found, needle_length_mm)
