"""One servo step: from where the ball is to where it should be, as a joint path (Liu 2007, section 1).

    dX = R_base_c (target_c - ball_c),    dq = J^+ [dX; da]

J is the nominal Jacobian at the ball, da the needle's orientation error from forward kinematics. The way is cut into
short pieces with a Jacobian each, so that it is straight and can be checked for contacts. Near a singularity the
orientation is given up first: damped steps of the position alone (Nakamura and Hanafusa 1986), as long as the needle
turns by no more than a limit.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose, jacobian
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rotations import log_rotation

CHARACTERISTIC_MM = 300.0
"""Length by which millimetres are made comparable with radians: about half of a UR3's reach."""

MIN_SIGMA = 0.1
"""Smallest singular value of the scaled Jacobian from which on position and orientation are steered together."""

DAMPING = 0.05
"""Damping of a position-only step where the position itself is singular; none where it is not."""

PIECE_MM = 1.0
"""A step's way is cut into pieces no longer than this: over 1 mm the Jacobian of a UR3 errs by 2 or 3 micrometres."""


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
    """What one step may do."""

    step_mm: float = 10.0
    joint_step_rad: float = math.radians(10.0)
    """The largest turn of any joint."""
    drift_rad: float = math.radians(1.0)
    """How far the needle may turn away while only the position is steered."""


class Step(NamedTuple):
    """A step's way."""

    q_path: Floats
    """Shape (m, 6), rad: from where the arm stands; one row where it may not go anywhere."""
    stop: ServoStop | None
    """Why there is no way (on)."""
    position_only: bool
    """Whether some piece gave the orientation up."""


class CarriedRod(NamedTuple):
    """What the arm carries and how it is to be held."""

    model: UrModel
    rod_mm: float
    R_base_flange: Floats
    """Shape (3, 3): the orientation to keep."""


def ball_base(rod: CarriedRod, q: Floats) -> Floats:
    """Where the nominal arm has its ball, shape (..., 3), mm, base frame."""
    flange = flange_pose(rod.model, q)
    return np.asarray(flange[..., :3, 3] + rod.rod_mm * flange[..., :3, 2])


def ball_jacobian(rod: CarriedRod, q: Floats) -> Floats:
    """The nominal Jacobian at the ball, shape (6, 6): mm and rad per rad, for q of shape (6,)."""
    J = jacobian(rod.model, q)
    lever = rod.rod_mm * flange_pose(rod.model, q)[:3, 2]
    J[:3] += np.cross(J[3:].T, lever).T
    return J


def orientation_error(rod: CarriedRod, q: Floats) -> Floats:
    """The turn (3,), rad, base frame, that brings the flange back to the orientation to keep."""
    R = flange_pose(rod.model, q)[:3, :3]
    return log_rotation(rod.R_base_flange @ R.T)


def smallest_sigma(J: Floats) -> float:
    """Smallest singular value of a Jacobian (6, 6) with its lengths over ``CHARACTERISTIC_MM``."""
    return float(np.linalg.svd(_scaled(J), compute_uv=False)[-1])


def servo_step(rod: CarriedRod, q: Floats, move_base: Floats, limits: StepLimits) -> Step:
    """The way that moves the ball by a vector and keeps the needle's orientation.

    Args:
        rod: The arm and its rod.
        q: Shape (6,), rad: where the arm stands, as commanded.
        move_base: Shape (3,), mm.
        limits: A longer move is cut short; the next look sees what is left.
    """
    length = float(np.linalg.norm(move_base))
    move = move_base * min(1.0, limits.step_mm / max(length, 1e-12))
    count = max(1, math.ceil(min(length, limits.step_mm) / PIECE_MM))
    start, path, only_position = ball_base(rod, q), [np.asarray(q, dtype=np.float64)], False
    for piece in range(1, count + 1):
        here = path[-1]
        turn, blind = _piece(rod, here, start + move * (piece / count) - ball_base(rod, here))
        workcell = limits.joint_step_rad - np.abs(here - q).max()
        fraction = min(1.0, max(workcell, 0.0) / max(float(np.abs(turn).max()), 1e-12))
        there = here + fraction * turn
        stop = _refusal(rod, there, blind, limits)
        if stop is not None:
            return Step(np.array(path[:1]), stop, only_position or blind)
        only_position = only_position or blind
        path.append(there)
        if fraction < 1.0:
            break
    return Step(np.array(path), None, only_position)


def _piece(rod: CarriedRod, q: Floats, move: Floats) -> tuple[Floats, bool]:
    """Joint turns (6,) of one piece, and whether the orientation was given up."""
    J = ball_jacobian(rod, q)
    goal = np.concatenate([move / CHARACTERISTIC_MM, orientation_error(rod, q)])
    if smallest_sigma(J) >= MIN_SIGMA:
        return np.linalg.solve(_scaled(J), goal), False
    return damped(_scaled(J)[:3], goal[:3]), True


def damped(J: Floats, goal: Floats) -> Floats:
    """Damped least squares J^T (J J^T + lambda^2 I)^-1 goal; lambda grows from 0 where sigma_min falls below its limit.

    Args:
        J: Shape (m, n), m <= n, scaled.
        goal: Shape (m,).
    """
    sigma = float(np.linalg.svd(J, compute_uv=False)[-1])
    squared = DAMPING**2 * max(0.0, 1.0 - (sigma / MIN_SIGMA) ** 2)
    return np.asarray(J.T @ np.linalg.solve(J @ J.T + squared * np.eye(len(J)), goal))


def _refusal(rod: CarriedRod, q: Floats, blind: bool, limits: StepLimits) -> ServoStop | None:
    if not rod.model.within_limits(q):
        return ServoStop.JOINT_LIMIT
    if blind and np.linalg.norm(orientation_error(rod, q)) > limits.drift_rad:
        return ServoStop.SINGULAR
    return None


def _scaled(J: Floats) -> Floats:
    return np.concatenate([J[:3] / CHARACTERISTIC_MM, J[3:]])
