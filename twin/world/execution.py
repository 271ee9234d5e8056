"""Commands in, what happened out: the arm driven through its motors, step by step of the physics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.world.client import TIME_STEP_S, step
from puncture_twin.twin.world.contacts import touches
from puncture_twin.twin.world.workcell import SimulatedWorkcell

RECORD_EVERY = 4
"""Physics steps between two records: 60 records a second."""


class TouchAt(NamedTuple):
    """A contact of the arm with a body of the room, at one physics step."""

    step: int
    link: str
    body: str
    depth_mm: float


@dataclass(frozen=True, eq=False)
class Execution:
    """What was measured, one row for each of m records.

    Attributes:
        steps: Shape (m,), the number of the physics step of each record.
        q: Shape (m, 6), rad, what the encoders say: true angle minus offset.
        T_base_flange: Shape (m, 4, 4), mm, where the flange truly was.
        touches: Every contact at every physics step.
        max_speed: Shape (6,), rad/s, over every step.
    """

    steps: NDArray[np.int64]
    q: Floats
    T_base_flange: Floats
    touches: tuple[TouchAt, ...]
    max_speed: Floats


def execute(room: SimulatedWorkcell, q_command: Floats, joint_offsets: Floats) -> Execution:
    """Drive the arm from rest at the first command through all of them, one a physics step.

    Args:
        room: An open room.
        q_command: Shape (n, 6), rad, spaced by the physics time step.
        joint_offsets: Shape (6,), rad: true joint angle minus what the encoder says.
    """
    arm = room.arm
    speeds = np.gradient(q_command, TIME_STEP_S, axis=0) if len(q_command) > 1 else np.zeros_like(q_command)
    arm.place(q_command[0] + joint_offsets)
    rows: list[int] = []
    q: list[Floats] = []
    poses: list[Floats] = []
    seen: list[TouchAt] = []
    max_speed = np.zeros(6)
    for number, (angles, speed) in enumerate(zip(q_command, speeds, strict=True)):
        arm.command(angles + joint_offsets, speed)
        step(room.client)
        state = arm.state()
        max_speed = np.maximum(max_speed, np.abs(state.speed))
        seen += [TouchAt(number, t.link, room.bodies[t.body], t.depth_mm) for t in touches(arm)]
        if number % RECORD_EVERY == 0 or number == len(q_command) - 1:
            rows.append(number)
            q.append(state.q - joint_offsets)
            poses.append(arm.flange_pose())
    return Execution(np.array(rows), np.array(q), np.array(poses), tuple(seen), max_speed)
