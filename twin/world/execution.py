"""Execution by the position motors, step by step of the physics, and the contacts that the physics reports."""

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.world.arm import Arm
from puncture_twin.twin.world.client import TIME_STEP_S, pybullet, step, to_mm
from puncture_twin.twin.world.workcell import SimulatedWorkcell

RECORD_S = 4 * TIME_STEP_S
"""Between two records: 60 a second."""


@dataclass(frozen=True)
class ContactEvent:
    """The deepest contact of a link of the arm with a body of the workcell, at one time; NaN where only FCL saw it."""

    time_s: float
    link: str
    body: str
    depth_mm: float


@dataclass(frozen=True, eq=False)
class Execution:
    """Records of an execution, m rows: q (m, 6), rad, is true angle minus offset; speeds are over every step."""

    times_s: Floats  # shape (m,), of each record, from the first command
    q_command: Floats  # shape (m, 6), rad, commanded joints
    q: Floats
    T_base_flange: Floats  # shape (m, 4, 4), mm, true pose of the flange
    touches: tuple[ContactEvent, ...]
    max_speed: Floats  # shape (6,), rad/s, over every step


class Recorder:
    """Records the arm after physics steps: `RECORD_S` apart, and at the end."""

    def __init__(
        self, workcell: SimulatedWorkcell, q_command: Floats, joint_offsets: Floats, dt: float, start_s: float = 0.0
    ) -> None:
        self._workcell, self._q_command, self._joint_offsets = workcell, q_command, joint_offsets
        self._dt, self._start_s, self._every = dt, start_s, round(RECORD_S / dt)
        self._rows, self._q, self._poses = list[int](), list[Floats](), list[Floats]()
        self._touches, self._max_speed = list[ContactEvent](), np.zeros(6)

    def see(self, row: int) -> None:
        """Record after the step of a row."""
        state = self._workcell.arm.state()
        self._max_speed = np.maximum(self._max_speed, np.abs(state.speed))
        self._touches += touches(self._workcell, self._time(row))
        if row % self._every == 0 or row == len(self._q_command) - 1:
            self._rows.append(row)
            self._q.append(state.q - self._joint_offsets)
            self._poses.append(self._workcell.arm.flange_pose())

    def execution(self) -> Execution:
        """The records so far."""
        times = np.array([self._time(row) for row in self._rows])
        records = np.array(self._q), np.array(self._poses), tuple(self._touches), self._max_speed
        return Execution(times, self._q_command[self._rows], *records)

    def _time(self, row: int) -> float:
        return self._start_s + row * self._dt


def execute(workcell: SimulatedWorkcell, q_command: Floats, joint_offsets: Floats) -> Execution:
    """Move the arm by its position motors from rest at the first command through all of them, one a physics step.

    Commands (n, 6), rad, are spaced by it; offsets (6,), rad, are true joint angles minus the encoders'.
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
    names = ("times_s", "q_command", "q", "T_base_flange")
    times, command, q, T = (np.concatenate([getattr(first, name), getattr(then, name)]) for name in names)
    return Execution(times, command, q, T, first.touches + then.touches, np.maximum(first.max_speed, then.max_speed))


def touches(workcell: SimulatedWorkcell, time_s: float = 0.0) -> tuple[ContactEvent, ...]:
    """Contacts of the last physics step with bodies that have a name (pads of markers have none), in order.

    At most one for each link and body. Bullet takes the arm's links as the convex hulls of their meshes.
    """
    arm, deepest = workcell.arm, dict[tuple[int, int], float]()
    for point in pybullet.getContactPoints(bodyA=arm.body, physicsClientId=arm.client):
        other, link, distance_m = point[2], point[3], point[8]
        if distance_m <= 0 and other in workcell.bodies:
            deepest[link, other] = max(deepest.get((link, other), 0.0), -float(to_mm(distance_m)))
    touches = sorted(deepest.items())
    return tuple(ContactEvent(time_s, arm.link_name(link), workcell.bodies[other], mm) for (link, other), mm in touches)


def contact_force(arm: Arm, link: str) -> Floats:
    """The force of the workcell's bodies on one link, as of the last physics step: shape (3,), N, world frame."""
    force = np.zeros(3)
    for point in pybullet.getContactPoints(bodyA=arm.body, linkIndexA=arm.links[link], physicsClientId=arm.client):
        if point[2] != arm.body:
            normal, (first, along_first, second, along_second) = np.array(point[7]), point[10:14]
            force += point[9] * normal + first * np.array(along_first) + second * np.array(along_second)
    return force
