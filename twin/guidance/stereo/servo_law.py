"""One servo step: a joint path from where the ball is to where it should be; the mapping of the head; the posture.

    dX = R_base_c (target_c - ball_c),    dq = J^+ [dX; da]                             (Liu 2007, section 1)

J is the nominal Jacobian at the ball, da the needle's orientation error from forward kinematics. The path is cut into
short pieces with a Jacobian each, so that it is straight and can be checked for contacts. Near a singularity the
orientation is given up first: damped steps of the position alone (Nakamura and Hanafusa 1986), as long as the needle
rotates by no more than a limit.

`map_head` estimates c_T_m, from the image to the calibration frame, by markers that both cameras see. Each marker errs
in the image and in the cameras, and the cameras err most along their view. The fit weighs each marker by both
covariances (maximum likelihood; Gauss-Newton from the plain rigid fit), and its normal matrix says how far the mapped
target may be off. With equal round errors both agree with the plain fit and Fitzpatrick's formula.

`configurations` gives one orientation and one inverse-kinematics branch of the rod for every point of a session.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
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
from puncture_twin.planning.collision.state_checker import StateChecker
from puncture_twin.planning.geometry.gauss_newton import System, gauss_newton
from puncture_twin.planning.geometry.rigid import apply, frame_yz, log_rotation, pose, rotated_about
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.registration import register
from puncture_twin.planning.registration.residuals import Conditioning

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
    joint_step_rad: float = math.radians(10.0)
    """The largest rotation of any joint."""
    drift_rad: float = math.radians(1.0)
    """How far the needle may rotate away while only the position is controlled."""
    joints: int = 6
    """That move: of 5, the sixth, which turns the rod about itself, is held."""


class Step(NamedTuple):
    """The joint path of one step."""

    q_path: Floats
    """Shape (m, 6), rad: from the arm's configuration; one row where it may not move."""
    stop: ServoStop | None
    """Why the arm may not move; None where it may."""
    position_only: bool
    """Whether some piece gave the orientation up."""


class CarriedRod(NamedTuple):
    """The rod on the arm, and the orientation to keep."""

    model: UrModel
    rod_mm: float
    R_base_flange: Floats
    """Shape (3, 3): the orientation to keep."""


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
    """The joint path that moves the ball by a vector and keeps the needle's orientation.

    Args:
        q: Shape (6,), rad: the arm's commanded configuration.
        move_base: Shape (3,), mm.
        limits: A longer move is cut short; the next look sees what is left.
    """
    length = float(np.linalg.norm(move_base))
    move = move_base * min(1.0, limits.step_mm / max(length, 1e-12))
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
        stop = _refusal(rod, q_next, without_orientation, limits)
        if stop is not None:
            return Step(np.array(path[:1]), stop, position_only)
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
    """Damped least squares J^T (J J^T + lambda^2 I)^-1 goal; lambda grows from 0 where sigma_min falls below its limit.

    Args:
        J: Shape (m, n), m <= n, scaled.
        goal: Shape (m,).
    """
    sigma = float(np.linalg.svd(J, compute_uv=False)[-1])
    squared = DAMPING**2 * max(0.0, 1.0 - (sigma / MIN_SIGMA) ** 2)  # lambda^2
    return np.asarray(J.T @ np.linalg.solve(J @ J.T + squared * np.eye(len(J)), goal))


def _refusal(rod: CarriedRod, q: Floats, position_only: bool, limits: StepLimits) -> ServoStop | None:
    if not rod.model.within_limits(q):
        return ServoStop.JOINT_LIMIT
    if position_only and np.linalg.norm(orientation_error(rod, q)) > limits.drift_rad:
        return ServoStop.SINGULAR
    return None


def _scaled(J: Floats) -> Floats:
    return np.concatenate([J[:3] / CHARACTERISTIC_MM, J[3:]])


MAX_ITERATIONS = 20
CONVERGED = 1e-12
"""A step of the fit (mm and rad) below which it has arrived."""


class SeenMarkers(NamedTuple):
    """Markers as triangulated by the cameras."""

    points_c: Floats
    """Shape (n, 3), mm."""
    covariances: Floats
    """Shape (n, 3, 3), mm^2."""


@dataclass(frozen=True, eq=False)
class Mapping:
    """c_T_m with its covariance.

    Attributes:
        T_c_m: Shape (4, 4), rigid, mm.
        covariance: Shape (6, 6), of a turn (rad) about ``center_c`` and a shift (mm), axes of C.
        center_c: Shape (3,), the markers' centre, mm.
        residuals: Shape (n, 3), T_c_m markers_m - markers_c, mm.
        conditioning: The flags of an ill-conditioned marker set, at the middle of the targets.
    """

    T_c_m: Floats
    covariance: Floats
    center_c: Floats
    residuals: Floats
    conditioning: Conditioning

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
        """Expected (rms) error at points (n, 3) of the image frame, shape (n,), mm.

        Args:
            points_m: Where.
            target_mm: Standard deviation per axis with which the image has a target itself.
        """
        variance = np.trace(self.covariance_at(points_m), axis1=1, axis2=2) + 3 * target_mm**2
        return np.asarray(np.sqrt(variance))


def map_head(
    names: tuple[str, ...],
    seen: SeenMarkers,
    markers_m: Floats,
    image_mm: float,
    targets_m: Floats,
    *,
    where: str | Path = "mapping",
) -> Mapping:
    """Fit c_T_m to markers in the image and in C, weighted by both covariances.

    Args:
        names: The markers, n at least 3.
        markers_m: Shape (n, 3), mm: what the image has.
        image_mm: Standard deviation per axis of ``markers_m``.
        targets_m: Shape (k, 3), mm: where the error matters.

    Raises:
        InputError: Fewer than three markers, collinear, mirrored, a unit slip, or a marker far off.
    """
    pairs = MarkerPairs(names, np.asarray(markers_m, dtype=np.float64), seen.points_c)
    plain = register(pairs, method="rigid", target_ct=np.mean(targets_m, axis=0), where=where)
    covariances, center = seen.covariances + max(image_mm, 1e-9) ** 2 * np.eye(3), seen.points_c.mean(axis=0)
    roots = np.linalg.inv(np.linalg.cholesky(covariances))  # whiten each marker's residual

    def linearised(T: Floats) -> System[Floats]:
        fitted = apply(T, pairs.points_ct)
        slopes = roots @ turn_and_shift_slopes(fitted - center)
        return System((roots @ (fitted - seen.points_c)[:, :, None]).ravel(), slopes.reshape(-1, 6))

    def moved(T: Floats, step: Floats) -> Floats:
        return rotated_about(T, center, step)

    fit = gauss_newton(plain.T_base_ct, linearised, moved, _arrived, MAX_ITERATIONS)
    residuals = apply(fit.estimate, pairs.points_ct) - seen.points_c
    covariance = np.asarray(np.linalg.inv(fit.system.information), dtype=np.float64)
    return Mapping(fit.estimate, covariance, center, residuals, plain.conditioning)


def _arrived(_: System[Floats], step: Floats) -> bool:
    return bool(np.abs(step).max() < CONVERGED)


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
    """Joint angles that reach a set of points on one branch."""

    q: Floats
    """Shape (n, 6), rad."""
    branch: int
    """The inverse-kinematics branch of all of them. An arm's errors differ from branch to branch by millimetres, so
    what was calibrated on one is to be used on it."""


def configurations(rod: CarriedRod, points_base: Floats, checker: StateChecker, *, first: int | None = None) -> Posture:
    """Joint angles that put the ball on every point, all on one branch, free of contacts.

    Of the branches the one that stays farthest from every singularity is taken; of equals, which mirrored ones are, the
    one whose elbow is on the rod's side.

    Args:
        rod: The arm, its rod and its orientation.
        points_base: Shape (n, 3), mm.
        first: Try this branch before the others.

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
        found = checker.first_contact(q, needle_may_touch_patient=False)
        if found is None:
            return Posture(q, branch)
        why = f"{found.contact.body} would touch {found.contact.other} at point {found.at + 1} of {len(points_base)}"
    raise NoAnswerError(why, code="motion_touches")


def path_upward(rod: CarriedRod, points_base: Floats, up_mm: float) -> Floats:
    """Points (n, 3) farther back along the rod by a distance, mm: where the arm hovers."""
    return np.asarray(points_base - up_mm * rod.R_base_flange[:, 2])
