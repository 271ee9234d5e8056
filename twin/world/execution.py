"""Execution by the position motors, step by step of the physics, and the contacts that the physics reports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.world.arm import Arm
from puncture_twin.twin.world.client import TIME_STEP_S, pybullet, step, to_mm
from puncture_twin.twin.world.workcell import SimulatedWorkcell

RECORD_S = 4 * TIME_STEP_S
"""Between two records: 60 a second."""


class TouchAt(NamedTuple):
    """A contact of the arm with a body of the workcell, at one physics step."""

    time_s: float
    link: str
    body: str
    depth_mm: float


@dataclass(frozen=True, eq=False)
class Execution:
    """Records of an execution, one row for each of m.

    Attributes:
        times_s: Shape (m,), of each record, from the first command.
        q_command: Shape (m, 6), rad, commanded joints.
        q: Shape (m, 6), rad, what the encoders say: true angle minus offset.
        T_base_flange: Shape (m, 4, 4), mm, true pose of the flange.
        touches: Every contact at every physics step.
        max_speed: Shape (6,), rad/s, over every step.
    """

    times_s: Floats
    q_command: Floats
    q: Floats
    T_base_flange: Floats
    touches: tuple[TouchAt, ...]
    max_speed: Floats


class Recorder:
    """Records the arm after physics steps: `RECORD_S` apart, and at the end.

    Args:
        q_command: Shape (n, 6), rad, one row a physics step.
        joint_offsets: Shape (6,), rad: true joint angle minus what the encoder says.
        dt: The physics step, s.
    """

    def __init__(
        self, workcell: SimulatedWorkcell, q_command: Floats, joint_offsets: Floats, dt: float, start_s: float = 0.0
    ) -> None:
        self._room, self._q_command, self._joint_offsets = workcell, q_command, joint_offsets
        self._dt, self._start_s, self._every = dt, start_s, round(RECORD_S / dt)
        self._rows: list[int] = []
        self._q: list[Floats] = []
        self._poses: list[Floats] = []
        self._touches: list[TouchAt] = []
        self._max_speed = np.zeros(6)

    def see(self, row: int) -> None:
        """Record after the step of a row."""
        arm, state = self._room.arm, self._room.arm.state()
        self._max_speed = np.maximum(self._max_speed, np.abs(state.speed))
        time = self._time(row)
        self._touches += [TouchAt(time, t.link, self._room.bodies[t.body], t.depth_mm) for t in touches(arm)]
        if row % self._every == 0 or row == len(self._q_command) - 1:
            self._rows.append(row)
            self._q.append(state.q - self._joint_offsets)
            self._poses.append(arm.flange_pose())

    def execution(self) -> Execution:
        """The records so far."""
        times = np.array([self._time(row) for row in self._rows])
        found = np.array(self._q), np.array(self._poses), tuple(self._touches), self._max_speed
        return Execution(times, self._q_command[self._rows], *found)

    def _time(self, row: int) -> float:
        return self._start_s + row * self._dt


def execute(workcell: SimulatedWorkcell, q_command: Floats, joint_offsets: Floats) -> Execution:
    """Move the arm by its position motors from rest at the first command through all of them, one a physics step.

    Args:
        q_command: Shape (n, 6), rad, spaced by the physics time step.
        joint_offsets: Shape (6,), rad: true joint angle minus what the encoder says.
    """
    arm, recorder = workcell.arm, Recorder(workcell, q_command, joint_offsets, TIME_STEP_S)
    speeds = np.gradient(q_command, TIME_STEP_S, axis=0) if len(q_command) > 1 else np.zeros_like(q_command)
    arm.place(q_command[0] + joint_offsets)
    for row, (angles, speed) in enumerate(zip(q_command, speeds, strict=True)):
        arm.command(angles + joint_offsets, speed)
        step(workcell.client)
        recorder.see(row)
    return recorder.execution()


def joined(first: Execution, then: Execution) -> Execution:
    """Two executions, one after the other."""
    return Execution(
        np.concatenate([first.times_s, then.times_s]),
        np.concatenate([first.q_command, then.q_command]),
        np.concatenate([first.q, then.q]),
        np.concatenate([first.T_base_flange, then.T_base_flange]),
        first.touches + then.touches,
        np.maximum(first.max_speed, then.max_speed),
    )


class Touch(NamedTuple):
    """The deepest contact between one link and one body at one moment."""

    link: str
    """Name of the arm's link."""
    body: int
    """Id of the other body."""
    depth_mm: float
    """How far the two shapes overlap."""


def touches(arm: Arm) -> tuple[Touch, ...]:
    """Contacts of the last physics step, at most one for each link and body, in a fixed order.

    Bullet takes the arm's links as the convex hulls of their meshes.
    """
    deepest: dict[tuple[int, int], float] = {}
    for point in pybullet.getContactPoints(bodyA=arm.body, physicsClientId=arm.client):
        other, link, distance_m = point[2], point[3], point[8]
        if distance_m <= 0 and other != arm.body:
            key = (link, other)
            deepest[key] = max(deepest.get(key, 0.0), -float(to_mm(distance_m)))
    return tuple(Touch(arm.link_name(link), other, depth) for (link, other), depth in sorted(deepest.items()))


def contact_force(arm: Arm, link: str) -> Floats:
    """The force of the workcell's bodies on one link, as of the last physics step: shape (3,), N, world frame."""
    force = np.zeros(3)
    for point in pybullet.getContactPoints(bodyA=arm.body, linkIndexA=arm.links[link], physicsClientId=arm.client):
        if point[2] != arm.body:
            normal, (first, along_first, second, along_second) = np.array(point[7]), point[10:14]
            force += point[9] * normal + first * np.array(along_first) + second * np.array(along_second)
    return force
