"""The visual servo loop: look, move, look again, on what the cameras see of the ball and of the head.

The robot's own accuracy does not enter the error that is moved to zero; its kinematics only give the direction of a
step. Where the ball is not seen the arm does not move, and every path is checked for contacts before it is moved along.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.state_checker import Contact, StateChecker
from puncture_twin.planning.motion.path_check import FINER, RESOLUTION_RAD, dense_states, first_contact
from puncture_twin.twin.devices import Arm
from puncture_twin.twin.guidance.stereo.servo_law import CarriedRod, ServoStop, StepLimits, servo_step

DIVERGING_RATIO = 1.5
"""A step diverges if it leaves more than this times the error before it."""

DIVERGING_STEPS = 2
"""Diverging steps in a row that end the servo: a single one may be the play of the gears."""

NOISE_TOLERANCES = 3.0
"""Errors below this many tolerances are noise, and end no servo as diverging."""


class Seen(NamedTuple):
    """Ball and target as one look measures them, calibration frame c."""

    ball_c: Floats
    """Shape (3,), mm."""
    target_c: Floats
    """Shape (3,), mm: where the target is believed now."""
    covariance: Floats
    """Shape (3, 3), mm^2: of the ball's position."""


class Lost(NamedTuple):
    """A ball that was not found."""

    reason: str


Look = Callable[[Floats], Seen | Lost]
"""Function of the commanded joints (6,), rad: a measurement."""


@dataclass(frozen=True, eq=False)
class Task:
    """Target, limits and devices of one servo.

    Attributes:
        rod: The arm, its rod and the orientation to keep.
        T_base_c: Shape (4, 4), mm: from the calibration frame c to the base, as calibrated (Liu's r_T_c).
        tolerance_mm: The servo has converged when a look sees no larger error.
        looks: Looks at most before a ball counts as lost.
        checker: Checks contacts, with the head where it is believed to be.
    """

    rod: CarriedRod
    T_base_c: Floats
    tolerance_mm: float
    max_steps: int
    looks: int
    limits: StepLimits
    checker: StateChecker


class Visit(NamedTuple):
    """One stop of the arm: commanded joints, and what was seen."""

    q_command: Floats
    seen: Seen
    error_mm: float
    """From the ball seen to the target believed."""


@dataclass(frozen=True, eq=False)
class Servoed:
    """Result of a servo.

    Attributes:
        visits: Every stop at which the ball was seen, in order.
        q_command: Shape (6,), rad: the last command.
        detail: What was touched or missing, for people.
        position_only: Whether some step gave the orientation up.
    """

    stop: ServoStop
    visits: tuple[Visit, ...]
    q_command: Floats
    detail: str = ""
    position_only: bool = False

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
    """Move the ball onto the target: look, measure the error, move a step; until it converges or must stop.

    Args:
        q_command: Shape (6,), rad: where the arm was sent.
        arm: Moves the ball.
    """
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
        stop = _stop_reason(task, visits)
        if stop is not None:
            return ended(stop)
        step = servo_step(task.rod, q_command, task.T_base_c[:3, :3] @ error_c, task.limits)
        position_only = position_only or step.position_only
        if step.stop is not None:
            return ended(step.stop)
        contact = path_contact(task.checker, step.q_path)
        if contact is not None:
            return ended(ServoStop.CONTACT, f"{contact.body} and {contact.other}")
        q_command = step.q_path[-1]
        arm.move_jp(q_command)


def path_contact(checker: StateChecker, q_path: Floats) -> Contact | None:
    """First contact along waypoints (m, 6), rad, checked as finely as any motion; None if free."""
    return first_contact(checker, dense_states(checker, q_path, RESOLUTION_RAD / FINER))


def look_again(look: Look, q_command: Floats, looks: int) -> Seen | Lost:
    """Look, and look again where the ball was not found, without moving the arm."""
    found = look(q_command)
    for _ in range(looks - 1):
        if isinstance(found, Seen):
            break
        found = look(q_command)
    return found


def _stop_reason(task: Task, visits: list[Visit]) -> ServoStop | None:
    """Why to stop after the last look; None to go on."""
    errors = [visit.error_mm for visit in visits]
    if errors[-1] <= task.tolerance_mm:
        return ServoStop.CONVERGED
    last = errors[-DIVERGING_STEPS - 1 :]
    worse = [b > DIVERGING_RATIO * a for a, b in pairwise(last)]
    if len(worse) == DIVERGING_STEPS and all(worse) and errors[-1] > NOISE_TOLERANCES * task.tolerance_mm:
        return ServoStop.DIVERGING
    if len(visits) > task.max_steps:
        return ServoStop.TOLERANCE_NOT_REACHED
    return None
