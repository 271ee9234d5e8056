"""The arm under a controller or its own motors, step by step: what it felt and where its tip went."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.world.arm import Arm
from puncture_twin.twin.world.client import TIME_STEP_S, set_time_step, step
from puncture_twin.twin.world.contacts import felt_force
from puncture_twin.twin.world.control.reference import Reference
from puncture_twin.twin.world.control.tip import Tip

TIP_LINK = "needle"


class Measured(NamedTuple):
    """What a controller is told at one step."""

    q: Floats
    """Shape (6,), rad, what the encoders say."""
    speed: Floats
    """Shape (6,), rad/s."""
    force_n: Floats
    """Shape (3,), of contact at the tip, base frame."""


class Torques(NamedTuple):
    """For the next step, the motors off."""

    torque_nm: Floats
    """Shape (6,)."""


class Goals(NamedTuple):
    """Of the position motors."""

    q: Floats
    """Shape (6,), rad, encoders."""
    speed: Floats
    """Shape (6,), rad/s."""


class Controller(Protocol):
    """Moves the joints from one step to the next."""

    dt: float

    def act(self, measured: Measured, reference: Reference, row: int) -> Torques | Goals:
        """What the joints shall do in the next step."""


class Push(NamedTuple):
    """A force on the needle, which is rigid here: where it acts along the shaft decides its moment on the arm."""

    force_n: Floats
    """Shape (3,), base frame."""
    point_m: Floats
    """Shape (3,), base frame."""


Resistance = Callable[[Tip], Sequence[Push]]
"""What tissue presses on the needle with, now that its tip is there (one row). It may remember where the tip was."""


@dataclass(frozen=True, eq=False)
class Run:
    """One row a step: at its start, and the force of the step before.

    Attributes:
        dt: Between rows, s.
        q: Shape (n, 6), rad, encoders.
        tip_m: Shape (n, 3), where the tip truly was, base frame.
        force_n: Shape (n, 3), N, on the tip.
        stopped: Whether it ended before its reference did.
    """

    dt: float
    q: Floats
    tip_m: Floats
    force_n: Floats
    stopped: bool


Stop = Callable[[Measured], bool]


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What acts on the arm besides its controller.

    Attributes:
        joint_offsets: Shape (6,), rad: true joint angle minus what the encoder says.
        resistance: Of tissue; None for none.
        stop: Ends the run where it says so; None never does.
        watch: Called after each step.
    """

    joint_offsets: Floats
    resistance: Resistance | None = None
    stop: Stop | None = None
    watch: Callable[[int], None] | None = None


def run(
    arm: Arm, controller: Controller, reference: Reference, tip_of: Callable[[Floats], Tip], around: Surroundings
) -> Run:
    """Follow a reference from where the arm is.

    Args:
        arm: Of an open room whose world is the base frame.
        controller: Its step becomes that of the physics.
        reference: What is wanted, a row a step.
        tip_of: The true tip of true joints.
        around: What else acts.
    """
    set_time_step(arm.client, controller.dt)
    arm.release()  # motors that hold on would work against torques; goals switch them on again
    q, places, forces = [], [], []
    for row in range(len(reference)):
        state = arm.state()
        tip = tip_of(state.q)
        force = felt_force(arm, TIP_LINK)
        for push in () if around.resistance is None else around.resistance(tip):
            arm.push(TIP_LINK, push.force_n, push.point_m)
            force = force + push.force_n
        measured = Measured(state.q - around.joint_offsets, state.speed, force)
        q.append(measured.q)
        places.append(tip.position_m[0])
        forces.append(force)
        if around.stop is not None and around.stop(measured):
            break
        _give(arm, controller.act(measured, reference, row), around.joint_offsets)
        step(arm.client)
        if around.watch is not None:
            around.watch(row)
    return Run(controller.dt, np.array(q), np.array(places), np.array(forces), len(q) < len(reference))


def _give(arm: Arm, action: Torques | Goals, joint_offsets: Floats) -> None:
    if isinstance(action, Torques):
        arm.torque(action.torque_nm)
    else:
        arm.command(action.q + joint_offsets, action.speed)


class Motors:
    """The reference's joints are the motors' goals, whatever is measured."""

    dt = TIME_STEP_S

    def act(self, measured: Measured, reference: Reference, row: int) -> Goals:
        """Goals of the next step."""
        del measured
        return Goals(reference.q[row], reference.speed[row])
