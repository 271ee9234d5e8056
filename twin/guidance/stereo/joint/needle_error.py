"""Covariance of the needle's pose against the anatomy: by arm and mapping alone, and after the servo.

With F the information matrix of the joint model, d the tip minus the target and phi the needle's rotation, both in the
image's axes at the target, every row of E says what an unknown does to them:

    Sigma6 = E F^-1 E' + arrival + R_m_flange diag(tip_offset^2, needle_direction^2) R' + what the head moved since

Before the servo the ball's rows are those of base and arm, and the arrival is new: J Jq Sigma_q Jq' J'. After it they
are those of the ball at the last image, so that the arm drops out of d; phi stays the arm's, but for what the last
image says of this arrival: with r the ball's deviation from where the arm should have it, the joints missed by

    eps | r ~ N(K r, Sigma_q - K Jq Sigma_q),   K = Sigma_q Jq' (Jq Sigma_q Jq')^-1
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.special import chdtri

from puncture_twin.planning.arm.kinematics import PARAMETERS
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, left_jacobian
from puncture_twin.planning.uncertainty.hit import hit_in_mesh, rays_to_ball
from puncture_twin.twin.guidance.stereo.joint.joint_model import FLOOR_MM, Adjusted
from puncture_twin.twin.guidance.stereo.servo_law import turn_and_shift_slopes

REGION = 0.95
"""Chance of the reported ellipsoid."""


@dataclass(frozen=True, eq=False)
class NeedleError:
    """Predicted error of a needle in place, image axes.

    Attributes:
        offset_m: Shape (3,), mm: the tip as believed, minus the target: what a tolerance or a wrong arm leaves.
        R_m_needle: Shape (3, 3): the needle's axes as believed, as columns, z to the tip.
        covariance: Shape (6, 6): Sigma6 about that, shift (mm) of the tip against the anatomy, then rotation (rad).
        target_covariance: Shape (3, 3), mm^2: of the reading of the target.
    """

    offset_m: Floats
    R_m_needle: Floats
    covariance: Floats
    target_covariance: Floats

    def __post_init__(self) -> None:
        for field in fields(self):
            getattr(self, field.name).setflags(write=False)

    @property
    def tip_covariance(self) -> Floats:
        """Covariance of the tip about the intended point, its reading included, shape (3, 3), mm^2."""
        return np.asarray(self.covariance[:3, :3] + self.target_covariance)

    @property
    def rms_mm(self) -> float:
        """Expected (rms) distance of the tip from the intended point, mm."""
        return float(np.sqrt(self.offset_m @ self.offset_m + np.trace(self.tip_covariance)))

    @property
    def direction_rms(self) -> float:
        """Expected (rms) angle between the needle and where it is believed to point, rad."""
        across = self.R_m_needle[:, :2]
        return float(np.sqrt(np.trace(across.T @ self.covariance[3:, 3:] @ across)))

    @property
    def half_axes_mm(self) -> Floats:
        """Half axes of the tip's 95 % ellipsoid about `offset_m`, shape (3,), mm, longest first."""
        return np.asarray(np.sqrt(chdtri(3, 1 - REGION) * np.linalg.eigvalsh(self.tip_covariance)[::-1]))

    @property
    def depth_mm(self) -> float:
        """Standard deviation of the tip along the needle, mm."""
        return float(np.sqrt(self.R_m_needle[:, 2] @ self.tip_covariance @ self.R_m_needle[:, 2]))

    @property
    def lateral_mm(self) -> float:
        """Root of the tip's variance across the needle, mm."""
        return float(np.sqrt(max(np.trace(self.tip_covariance) - self.depth_mm**2, 0.0)))

    def p_hit(self, radius_mm: float) -> float:
        """The chance that the tip is within a radius of the target."""
        return float(hit_in_mesh(rays_to_ball(self.offset_m, radius_mm), self.tip_covariance[None])[0])


def servoed_error(found: Adjusted, stay: int, target_m: Floats) -> NeedleError:
    """The needle's error after an image of the ball.

    Args:
        stay: Which of the stays; -1 is the last.
        target_m: Shape (3,), mm, as the image has it.
    """
    model, x = found.model, found.unknowns
    stay = stay % len(x.balls_c)
    miss, slopes = model.ball_deviations(x, np.array([stay]))
    rod, frame = _Flange.of(found, model.observed.q_command[stay]), _Anatomy.of(found, target_m)
    variance, Jq = model.observed.errors.arrival**2, rod.arrival_slopes
    K = variance * Jq[:3].T @ np.linalg.inv(variance * Jq[:3] @ Jq[:3].T + FLOOR_MM**2 * np.eye(3))
    rows = np.zeros((6, len(found.covariance)))
    start = x.span("balls_c").start + 3 * stay
    rows[:3, start : start + 3] = np.eye(3)  # the tip follows the ball that was seen
    rows[3:] = rod.rows[3:] + Jq[3:] @ K @ slopes[0]
    again = np.zeros((6, 6))
    again[3:, 3:] = Jq[3:] @ (variance * (np.eye(6) - K @ Jq[:3])) @ Jq[3:].T  # of this arrival, given r
    R_c_flange = exp_rotation(Jq[3:] @ K @ miss[0]) @ rod.R_c_flange  # by its mean, K r
    return frame.needle(found, x.balls_c[stay], R_c_flange, rows, again)


def open_loop_error(found: Adjusted, q_command: Floats, target_m: Floats) -> NeedleError:
    """The needle's error where the arm is sent without an image.

    Args:
        found: The joint estimate of what was measured before.
        q_command: Shape (6,), rad.
        target_m: Shape (3,), mm, as the image has it.
    """
    rod, frame = _Flange.of(found, q_command), _Anatomy.of(found, target_m)
    Jq = rod.arrival_slopes
    arrival = found.model.observed.errors.arrival**2 * Jq @ Jq.T
    return frame.needle(found, rod.ball_c, rod.R_c_flange, rod.rows, arrival)


@dataclass(frozen=True, eq=False)
class _Flange:
    """Predicted ball and flange of the arm, C.

    Attributes:
        ball_c: Shape (3,), mm.
        R_c_flange: Shape (3, 3).
        rows: Shape (6, N): shift of the ball and rotation of the flange by the unknowns.
        arrival_slopes: Shape (6, 6): shift of the ball and rotation of the flange per rad of each joint.
    """

    ball_c: Floats
    R_c_flange: Floats
    rows: Floats
    arrival_slopes: Floats

    @classmethod
    def of(cls, found: Adjusted, q_command: Floats) -> _Flange:
        model, x = found.model, found.unknowns
        T, one = model.pose_of_base(x), model.rod_at(x, q_command[None])
        turn = np.kron(np.eye(2), T[:3, :3])
        ball = apply(T, one.ball)
        rows = np.zeros((6, len(found.covariance)))
        rows[:3, x.span("base")] = model.base_slopes(x, ball)[0]
        rows[3:, x.span("base")] = _turn_rows(x.base)
        J = turn @ one.slopes[0]
        rows[:, x.span("arm")] = J * model.observed.errors.arm_deviations()
        return cls(ball[0], T[:3, :3] @ one.R_base_flange[0], rows, J[:, PARAMETERS["joint"]])


@dataclass(frozen=True, eq=False)
class _Anatomy:
    """The target at the head's estimated pose.

    Attributes:
        target_m: Shape (3,), mm.
        T_c_m: Shape (4, 4), mm.
        rows: Shape (6, N): shift of the target and rotation of the head, C, by the unknowns.
    """

    target_m: Floats
    T_c_m: Floats
    rows: Floats

    @classmethod
    def of(cls, found: Adjusted, target_m: Floats) -> _Anatomy:
        model, x = found.model, found.unknowns
        T_c_m = model.pose_of_head(x)
        rows = np.zeros((6, len(found.covariance)))
        rows[:3, x.span("head")] = model.head_slopes(x, apply(T_c_m, target_m[None]))[0]
        rows[3:, x.span("head")] = _turn_rows(x.head)
        return cls(target_m, T_c_m, rows)

    def needle(self, found: Adjusted, ball_c: Floats, R_c_flange: Floats, rows: Floats, again: Floats) -> NeedleError:
        """The needle against this target; ``again`` (6, 6), C, is what errs besides the unknowns."""
        errors, R = found.model.observed.errors, self.T_c_m[:3, :3]
        rows = rows - self.rows  # tip minus target
        rotated = np.kron(np.eye(2), R_c_flange)
        tool = np.repeat([errors.tip_offset_mm, errors.needle_direction, 0.0], [3, 2, 1]) ** 2  # no roll
        cov_c = rows @ found.covariance @ rows.T + again + (rotated * tool) @ rotated.T
        turn = np.kron(np.eye(2), R)
        covariance = turn.T @ cov_c @ turn + self._moved(found)
        offset = R.T @ (ball_c - apply(self.T_c_m, self.target_m))
        return NeedleError(offset, R.T @ R_c_flange, covariance, errors.target_mm**2 * np.eye(3))

    def _moved(self, found: Adjusted) -> Floats:
        """Covariance of the head's motion after its markers were seen, (6, 6), image axes, about their middle."""
        errors, lever = found.model.observed.errors, self.target_m - found.unknowns.markers_m.mean(axis=0)
        slopes = np.zeros((6, 6))
        slopes[:3], slopes[3:, :3] = turn_and_shift_slopes(lever[None])[0], np.eye(3)
        return np.asarray((slopes * np.repeat([errors.head_turn, errors.head_shift_mm], 3) ** 2) @ slopes.T)


def _turn_rows(change: Floats) -> Floats:
    """Rotation of a pose by the rotation and shift (6,) of `rotated_about`, shape (3, 6)."""
    return np.concatenate([left_jacobian(change[:3]), np.zeros((3, 3))], axis=1)
