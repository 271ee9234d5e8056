"""The visual servo: look, move a step, look again; the mapping of the head; the posture.

    dX = R_base_c (target_c - ball_c),    dq = J^+ [dX; da]                             (Liu 2007, section 1)

J is the nominal Jacobian at the ball, da the needle's orientation error from forward kinematics. The path is cut into
short pieces with a Jacobian each, so that it is straight and can be checked for contacts. Near a singularity the
orientation is given up first: damped steps of the position alone (Nakamura and Hanafusa 1986), as long as the needle
rotates by no more than a limit. The robot's own accuracy does not enter the error that is moved to zero. Where the ball
is not seen the arm does not move, and every path is checked for contacts before it is moved along.

`map_head` estimates c_T_m, from the image to the calibration frame, by markers that both cameras see. Each marker errs
in the image and in the cameras, and the cameras err most along their view. The fit weighs each marker by both
covariances (maximum likelihood; Gauss-Newton from the plain rigid fit), and its normal matrix says how far the mapped
target may be off. With equal round errors both agree with the plain fit and Fitzpatrick's formula.

`configurations` gives one orientation and one inverse-kinematics branch of the rod for every point of a session.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import (
    ELBOW,
    ELBOW_DIGITS,
    TIE_DIGITS,
    flange_pose,
    jacobian,
    link_poses,
    singularity,
)
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, rms
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.collision.bodies import Contact
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.geometry.gauss_newton import System, gauss_newton
from puncture_twin.planning.geometry.rigid import apply, frame_yz, log_rotation, pose, rotated_about
from puncture_twin.planning.motion.path_check import FINER, RESOLUTION_RAD, dense_states, first_contact
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.registration import Conditioning, register
from puncture_twin.twin.devices import Arm
from puncture_twin.twin.guidance.stereo.camera_calibration import Points

CHARACTERISTIC_MM = 300.0
"""Length by which millimetres are made comparable with radians: about half of a UR3's reach."""
MIN_SIGMA = 0.1
"""Smallest singular value of the scaled Jacobian from which on position and orientation are controlled together."""
DAMPING = 0.05
"""Damping of a position-only step where the position itself is singular; none where it is not."""
PIECE_MM = 1.0
"""A step's path is cut into pieces no longer than this: over 1 mm the Jacobian of a UR3 errs by 2 or 3 micrometres."""


class ServoStop(StrEnum):
    """Why the servo ended."""

    CONVERGED = "converged"
    TOLERANCE_NOT_REACHED = "tolerance_not_reached"
    DIVERGING = "diverging"
    SINGULAR = "singular"
    LOST_BALL = "lost_ball"
    JOINT_LIMIT = "joint_limit"
    CONTACT = "contact"


class StepLimits(NamedTuple):
    """Limits of one step."""

    step_mm: float = 10.0
    joint_step_rad: float = math.radians(10.0)  # the largest rotation of any joint
    drift_rad: float = math.radians(1.0)  # how far the needle may rotate away while only the position is controlled
    joints: int = 6  # that move: of 5 the sixth, which turns the rod about itself, is held


class Step(NamedTuple):
    """The joint path of one step."""

    q_path: Floats  # shape (m, 6), rad: from the arm's configuration; one row where it may not move
    stop: ServoStop | None  # why the arm may not move
    position_only: bool  # whether some piece gave the orientation up


class CarriedRod(NamedTuple):
    """The rod on the arm, and the orientation (3, 3) to keep."""

    model: UrModel
    rod_mm: float
    R_base_flange: Floats  # shape (3, 3): the orientation to keep


def ball_base(rod: CarriedRod, q: Floats) -> Floats:
    """Position of the nominal arm's ball, shape (..., 3), mm, base frame."""
    flange = flange_pose(rod.model, q)
    return np.asarray(flange[..., :3, 3] + rod.rod_mm * flange[..., :3, 2])


def ball_jacobian(rod: CarriedRod, q: Floats) -> Floats:
    """The nominal Jacobian at the ball, shape (6, 6): mm and rad per rad, for q of shape (6,)."""
    J = jacobian(rod.model, q)
    lever = rod.rod_mm * flange_pose(rod.model, q)[:3, 2]
    J[:3] += np.cross(J[3:].T, lever).T  # v_ball = v_flange + w x r
    return J


def orientation_error(rod: CarriedRod, q: Floats) -> Floats:
    """The rotation (3,), rad, base frame, that brings the flange back to the orientation to keep."""
    R = flange_pose(rod.model, q)[:3, :3]
    return log_rotation(rod.R_base_flange @ R.T)


def smallest_sigma(J: Floats) -> float:
    """Smallest singular value of a Jacobian (6, 6) or (6, 5) with its lengths over ``CHARACTERISTIC_MM``."""
    return float(np.linalg.svd(_scaled(J), compute_uv=False)[-1])


def servo_step(rod: CarriedRod, q: Floats, move_base: Floats, limits: StepLimits) -> Step:
    """The joint path from joints (6,), rad, that moves the ball by a vector (3,), mm, and keeps its orientation."""
    length = float(np.linalg.norm(move_base))
    move = move_base * min(1.0, limits.step_mm / max(length, 1e-12))  # the next look sees what is left
    count = max(1, math.ceil(min(length, limits.step_mm) / PIECE_MM))
    start, path, position_only = ball_base(rod, q), [np.asarray(q, dtype=np.float64)], False
    for piece in range(1, count + 1):
        q_now = path[-1]
        goal = start + move * (piece / count)  # on the straight line: what the last pieces missed is made up for
        dq, without_orientation = _piece(rod, q_now, goal - ball_base(rod, q_now), limits.joints)
        slack = limits.joint_step_rad - np.abs(q_now - q).max()
        fraction = min(1.0, max(slack, 0.0) / max(float(np.abs(dq).max()), 1e-12))
        q_next = q_now + fraction * dq
        position_only = position_only or without_orientation
        if not rod.model.within_limits(q_next):
            return Step(np.array(path[:1]), ServoStop.JOINT_LIMIT, position_only)
        if without_orientation and np.linalg.norm(orientation_error(rod, q_next)) > limits.drift_rad:
            return Step(np.array(path[:1]), ServoStop.SINGULAR, position_only)
        path.append(q_next)
        if fraction < 1.0:
            break
    return Step(np.array(path), None, position_only)


def _piece(rod: CarriedRod, q: Floats, move: Floats, joints: int) -> tuple[Floats, bool]:
    """Joint rotations (6,) of one piece, and whether the orientation was given up."""
    J, turn = ball_jacobian(rod, q)[:, :joints], orientation_error(rod, q)
    if joints == 5:  # what is left of the turn brings the rod's axis back
        turn = np.cross(flange_pose(rod.model, q)[:3, 2], rod.R_base_flange[:, 2])
    goal, dq = np.concatenate([move / CHARACTERISTIC_MM, turn]), np.zeros(6)
    together = smallest_sigma(J) >= MIN_SIGMA
    if together:
        dq[:joints] = np.linalg.lstsq(_scaled(J), goal)[0] if joints == 5 else np.linalg.solve(_scaled(J), goal)
    else:
        dq[:joints] = damped(_scaled(J)[:3], goal[:3])
    return dq, not together


def damped(J: Floats, goal: Floats) -> Floats:
    """Damped least squares J^T (J J^T + lambda^2 I)^-1 goal for a scaled J (m, n), m <= n, and a goal (m,)."""
    sigma = float(np.linalg.svd(J, compute_uv=False)[-1])
    squared = DAMPING**2 * max(0.0, 1.0 - (sigma / MIN_SIGMA) ** 2)  # lambda^2 grows where sigma is small
    return np.asarray(J.T @ np.linalg.solve(J @ J.T + squared * np.eye(len(J)), goal))


def _scaled(J: Floats) -> Floats:
    return np.concatenate([J[:3] / CHARACTERISTIC_MM, J[3:]])


MAX_ITERATIONS = 20
CONVERGED = 1e-12
"""A step of the fit (mm and rad) below which it has arrived."""


@dataclass(frozen=True, eq=False)
class Mapping:
    """The head in C by its markers, n."""

    T_c_m: Floats  # shape (4, 4), mm
    covariance: Floats  # shape (6, 6), of a turn (rad) about the markers' centre and a shift (mm), in C
    center_c: Floats  # shape (3,), the markers' centre, mm
    residuals: Floats  # shape (n, 3): T_c_m markers_m - markers_c, mm
    conditioning: Conditioning  # the flags of an ill-conditioned marker set, at the middle of the targets

    @property
    def fre_mm(self) -> float:
        """Root mean square residual. It is not the accuracy at the target."""
        return rms(self.residuals)

    def to_c(self, points_m: Floats) -> Floats:
        """Points (..., 3) of the image frame, in C, mm."""
        return apply(self.T_c_m, points_m)

    def covariance_at(self, points_m: Floats) -> Floats:
        """Covariance of mapped points (n, 3), shape (n, 3, 3), mm^2, C."""
        slope = turn_and_shift_slopes(self.to_c(points_m) - self.center_c)
        return np.asarray(slope @ self.covariance @ slope.transpose(0, 2, 1))

    def expected_tre_mm(self, points_m: Floats, target_mm: float = 0.0) -> Floats:
        """Expected (rms) error at points (n, 3) that the image has to within ``target_mm`` per axis, shape (n,), mm."""
        return np.asarray(np.sqrt(np.trace(self.covariance_at(points_m), axis1=1, axis2=2) + 3 * target_mm**2))


def map_head(
    names: tuple[str, ...], seen: Points, markers_m: Floats, image_mm: float, targets_m: Floats, where: str | Path
) -> Mapping:
    """Fit c_T_m to markers in the image (n, 3), n at least 3, and in C, weighted by both covariances; mm.

    ``image_mm`` is the standard deviation of ``markers_m`` per axis; at targets (k, 3) the error matters.

    Raises:
        InputError: Fewer than three markers, collinear, mirrored, a unit slip, or a marker far off.
    """
    pairs = MarkerPairs(names, np.asarray(markers_m, dtype=np.float64), seen.points_c)
    plain = register(pairs, method="rigid", target_ct=np.mean(targets_m, axis=0), where=where)
    covariances, center = seen.covariance + max(image_mm, 1e-9) ** 2 * np.eye(3), seen.points_c.mean(axis=0)
    roots = np.linalg.inv(np.linalg.cholesky(covariances))  # whiten each marker's residual

    def linearised(T: Floats) -> System[Floats]:
        fitted = apply(T, pairs.points_ct)
        slopes = roots @ turn_and_shift_slopes(fitted - center)
        return System((roots @ (fitted - seen.points_c)[:, :, None]).ravel(), slopes.reshape(-1, 6))

    fit = gauss_newton(
        plain.T_base_ct,
        linearised,
        lambda T, step: rotated_about(T, center, step),
        lambda _, step: bool(np.abs(step).max() < CONVERGED),
        MAX_ITERATIONS,
    )
    residuals = apply(fit.estimate, pairs.points_ct) - seen.points_c
    covariance = np.asarray(np.linalg.inv(fit.system.information), dtype=np.float64)
    return Mapping(fit.estimate, covariance, center, residuals, plain.conditioning)


def turn_and_shift_slopes(offsets: Floats) -> Floats:
    """Derivative (n, 3, 6) of points by a turn about a centre and a shift; ``offsets`` (n, 3), mm, from that centre."""
    x, y, z = offsets.T
    zero = np.zeros_like(x)
    turn = np.stack([np.stack(row, axis=-1) for row in ((zero, z, -y), (-z, zero, x), (y, -x, zero))], axis=1)
    return np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], axis=2)


LEAST_SINGULARITY = 0.05
"""A branch that comes nearer to a singularity (of 0..1) at some point is not used."""
REFERENCE_RAD = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])
"""Whole turns are chosen nearest to this: arm up, elbow bent, flange down."""


def rod_orientation(tilt_rad: float) -> Floats:
    """R_base_flange, shape (3, 3): the flange looks down, its rod leaning away from the arm by an angle, rad."""
    z = np.array([np.sin(tilt_rad), 0.0, -np.cos(tilt_rad)])
    y = np.array([0.0, -1.0, 0.0])
    return frame_yz(y, z)


def flange_poses(rod: CarriedRod, points_base: Floats) -> Floats:
    """T_base_flange, shape (n, 4, 4), mm, that put the ball on points (n, 3)."""
    return pose(rod.R_base_flange, points_base - rod.rod_mm * rod.R_base_flange[:, 2])


class Posture(NamedTuple):
    """Joint angles (n, 6), rad, that reach a set of points on one branch of the inverse kinematics.

    An arm's errors differ from branch to branch by millimetres, so what was calibrated on one is to be used on it.
    """

    q: Floats  # shape (n, 6), rad
    branch: int


def configurations(rod: CarriedRod, points_base: Floats, checker: CellChecker, *, first: int | None = None) -> Posture:
    """Joint angles that put the ball on every point (n, 3), mm, all on one branch, free of contacts.

    The branch ``first`` is tried first, then the one that stays farthest from every singularity; of equals, which
    mirrored ones are, the one whose elbow is on the rod's side.

    Raises:
        NoAnswerError: No branch holds all points freely; says what the best one lacks.
    """
    every = inverse(rod.model, flange_poses(rod, points_base))
    least = np.nan_to_num(singularity(rod.model, every).least(), nan=0.0).min(axis=0)
    why = f"a {rod.model.name} cannot bring the ball to all {len(points_base)} points on one branch"
    elbow = np.nan_to_num(link_poses(rod.model, every[0])[:, ELBOW, :3, 3] @ -rod.R_base_flange[:, 2])
    ranks = np.column_stack([np.round(least, TIE_DIGITS), np.round(elbow, ELBOW_DIGITS)])
    order = sorted(range(len(ranks)), key=lambda branch: (branch != first, *-ranks[branch]))
    for branch in (branch for branch in order if least[branch] >= LEAST_SINGULARITY):
        q = nearest_within_limits(rod.model, every[:, branch], REFERENCE_RAD)
        if np.isnan(q).any():
            continue
        contact = checker.first_contact(q, needle_may_touch_patient=False)
        if contact is None:
            return Posture(q, branch)
        bodies = f"{contact.contact.body} would touch {contact.contact.other}"
        why = f"{bodies} at point {contact.at + 1} of {len(points_base)}"
    raise NoAnswerError(why, code="motion_touches")


DIVERGING_RATIO = 1.5
"""A step diverges if it leaves more than this times the error before it."""
DIVERGING_STEPS = 2
"""Diverging steps in a row that end the servo: a single one may be the play of the gears."""
NOISE_TOLERANCES = 3.0
"""Errors below this many tolerances are noise, and end no servo as diverging."""


class Seen(NamedTuple):
    """Ball and target as one look measures them, (3,), mm, in C, and the covariance (3, 3), mm^2, of the ball."""

    ball_c: Floats
    target_c: Floats
    covariance: Floats


class Lost(NamedTuple):
    """A ball that was not found, with the edges on the best circle."""

    reason: str
    inliers: int = 0


Look = Callable[[Floats], Seen | Lost]
"""Function of the commanded joints (6,), rad: a measurement."""


@dataclass(frozen=True, eq=False)
class Task:
    """Target, limits and devices of one servo."""

    rod: CarriedRod
    T_base_c: Floats  # shape (4, 4), mm, as calibrated (Liu's r_T_c)
    tolerance_mm: float  # it has converged when a look sees no error above
    max_steps: int
    looks: int  # after so many a ball counts as lost
    limits: StepLimits
    checker: CellChecker  # has the head where it is believed to be


class Visit(NamedTuple):
    """One stop of the arm: commanded joints, what was seen, and how far the ball seen is from the target believed."""

    q_command: Floats
    seen: Seen
    error_mm: float


@dataclass(frozen=True, eq=False)
class Servoed:
    """Result of a servo."""

    stop: ServoStop
    visits: tuple[Visit, ...]  # at which the ball was seen, in order
    q_command: Floats  # shape (6,), rad: the last command
    detail: str = ""  # what was touched or missing, for people
    position_only: bool = False  # whether some step gave the orientation up

    @property
    def ended_in_sight(self) -> bool:
        """Whether the ball was seen where the arm ended."""
        return bool(self.visits) and self.visits[-1].q_command is self.q_command

    @property
    def steps(self) -> int:
        """Number of corrections that were executed."""
        return max(0, len(self.visits) - 1)

    @property
    def errors_mm(self) -> Floats:
        """Measured error at each stop, shape (n,), mm."""
        return np.array([visit.error_mm for visit in self.visits])


def servo(task: Task, q_command: Floats, look: Look, arm: Arm) -> Servoed:
    """Move the ball onto the target from where the arm was sent, (6,), rad, until it converges or must stop."""
    visits: list[Visit] = []
    position_only = False

    def ended(stop: ServoStop, detail: str = "") -> Servoed:
        return Servoed(stop, tuple(visits), q_command, detail, position_only)

    while True:
        seen = look_again(look, q_command, task.looks)
        if isinstance(seen, Lost):
            return ended(ServoStop.LOST_BALL, seen.reason)
        error_c = seen.target_c - seen.ball_c
        visits.append(Visit(q_command, seen, float(np.linalg.norm(error_c))))
        errors = [visit.error_mm for visit in visits]
        if errors[-1] <= task.tolerance_mm:
            return ended(ServoStop.CONVERGED)
        worse = [b > DIVERGING_RATIO * a for a, b in pairwise(errors[-DIVERGING_STEPS - 1 :])]
        if len(worse) == DIVERGING_STEPS and all(worse) and errors[-1] > NOISE_TOLERANCES * task.tolerance_mm:
            return ended(ServoStop.DIVERGING)
        if len(visits) > task.max_steps:
            return ended(ServoStop.TOLERANCE_NOT_REACHED)
        step = servo_step(task.rod, q_command, task.T_base_c[:3, :3] @ error_c, task.limits)
        position_only = position_only or step.position_only
        if step.stop is not None:
            return ended(step.stop)
        contact = path_contact(task.checker, step.q_path)
        if contact is not None:
            return ended(ServoStop.CONTACT, f"{contact.body} and {contact.other}")
        q_command = step.q_path[-1]
        arm.move_jp(q_command)


def path_contact(checker: CellChecker, q_path: Floats) -> Contact | None:
    """First contact along waypoints (m, 6), rad, checked as finely as any motion; None if free."""
    return first_contact(checker, dense_states(checker, q_path, RESOLUTION_RAD / FINER))


def look_again(look: Look, q_command: Floats, looks: int) -> Seen | Lost:
    """Look, and look again where the ball was not found, without moving the arm."""
    seen = look(q_command)
    for _ in range(looks - 1):
        if isinstance(seen, Seen):
            break
        seen = look(q_command)
    return seen
