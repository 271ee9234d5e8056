"""A motion of the tip under one of the controllers, taken over from the position motors while the arm is at rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.twin.world.client import TIME_STEP_S
from puncture_twin.twin.world.control.gains import Stiffness, allowed_step
from puncture_twin.twin.world.control.impedance import Impedance
from puncture_twin.twin.world.control.reference import Reference, reference_of
from puncture_twin.twin.world.control.rigid_model import RigidModel, rigid_model
from puncture_twin.twin.world.control.run import Controller, Goals, Measured, Motors, Resistance, Surroundings, run
from puncture_twin.twin.world.control.tip import tips
from puncture_twin.twin.world.execution import Execution, Recorder
from puncture_twin.twin.world.units import to_m, to_mm
from puncture_twin.twin.world.workcell import SimulatedWorkcell

TipControl = Literal["impedance", "admittance", "position"]
"""A spring at the tip by joint torques, or by moved goals of the position motors; or those motors alone."""


@dataclass(frozen=True, eq=False)
class Insertion:
    """A straight motion of the tip.

    Attributes:
        model: The arm.
        tool: What its flange carries.
        down_base: Shape (3,), unit vector of gravity, base frame.
        trajectory: From rest to rest.
        hold_s: How long its end is held.
    """

    model: UrModel
    tool: Tool
    down_base: Floats
    trajectory: Trajectory
    hold_s: float


class Inserted(NamedTuple):
    """What happened, and how far the tip was from where it should be, as the encoders say, at most, mm."""

    execution: Execution
    off_path_mm: float


def insert(
    workcell: SimulatedWorkcell,
    insertion: Insertion,
    control: TipControl,
    joint_offsets: Floats,
    *,
    start_s: float = 0.0,
    resistance: Resistance | None = None,
) -> Inserted:
    """Run an insertion from where the arm is.

    Args:
        workcell: An open room, its arm at rest at the trajectory's start.
        insertion: What is wanted.
        control: How the tip follows it.
        joint_offsets: Shape (6,), rad: true joint angle minus what the encoder says.
        start_s: Time of its first step.
        resistance: Of tissue; None for none.

    Raises:
        InputError: No time step carries the stiffness at some pose of the path.
    """
    model, tip_m = insertion.model, float(to_m(insertion.tool.needle_length_mm))
    with rigid_model(model, insertion.tool, insertion.down_base) as rigid:
        controller = _controller(rigid, control, insertion.trajectory.q)
        reference = reference_of(model, tip_m, insertion.trajectory, controller.dt, insertion.hold_s)
        recorder = Recorder(workcell, reference.q, joint_offsets, controller.dt, start_s)
        around = Surroundings(joint_offsets, resistance, watch=recorder.see)
        done = run(workcell.arm, controller, reference, lambda q: tips(model, tip_m, q[None]), around)
    off_m = np.linalg.norm(tips(model, tip_m, done.q).position_m - reference.position_m, axis=1)
    return Inserted(recorder.execution(), float(to_mm(off_m.max())))


def _controller(rigid: RigidModel, control: TipControl, q_path: Floats) -> Controller:
    """The controller with the longest step that the whole path allows."""
    if control == "position":
        return Motors()
    if control == "admittance":
        return Admittance(rigid.kinematics, rigid.tip_m, VirtualMass(), TIME_STEP_S)
    stiffness = Stiffness()
    J = tips(rigid.kinematics, rigid.tip_m, q_path).J
    dt = min(allowed_step(stiffness, row, rigid.mass_matrix(q)) for q, row in zip(q_path, J, strict=True))
    return Impedance(rigid, stiffness, dt, keep_compliance=False)


MOST_DECAY = 2.0
"""Of D dt / M: from there on the explicit step of the virtual mass overshoots more than it takes away."""


@dataclass(frozen=True)
class VirtualMass:
    """What the tip pretends to be: M x'' + D x' + K x = F."""

    mass_kg: float = 1.0
    damping_ns_m: float = 63.0
    stiffness_n_m: float = 1e3


class Admittance:
    """The controller: it keeps the virtual mass's place and speed, shape (3,) each, m and m/s, base frame.

    Args:
        model: The arm, nominal.
        tip_m: Flange to tip.
        virtual: The mass.
        dt: Its step, s.

    Raises:
        InputError: The virtual mass would diverge with this step.
    """

    def __init__(self, model: UrModel, tip_m: float, virtual: VirtualMass, dt: float) -> None:
        decay = virtual.damping_ns_m * dt / virtual.mass_kg
        if not decay < MOST_DECAY:
            raise InputError(
                f"D dt / M = {decay:.2f} would diverge", where="admittance", allowed=f"below {MOST_DECAY:g}"
            )
        self.dt = dt
        self._model, self._tip_m, self._virtual = model, tip_m, virtual
        self._place, self._velocity = np.zeros(3), np.zeros(3)

    def act(self, measured: Measured, reference: Reference, row: int) -> Goals:
        """Goals of the position motors for the next step."""
        self._yield(measured.force_n)
        J = tips(self._model, self._tip_m, measured.q[None]).J[0]
        moved = np.linalg.solve(J, np.concatenate([self._place, np.zeros(3)]))
        speed = np.linalg.solve(J, np.concatenate([self._velocity, np.zeros(3)]))
        return Goals(reference.q[row] + moved, reference.speed[row] + speed)

    def _yield(self, force_n: Floats) -> None:
        of = self._virtual
        pull = force_n - of.damping_ns_m * self._velocity - of.stiffness_n_m * self._place
        self._velocity = self._velocity + self.dt / of.mass_kg * pull
        self._place = self._place + self.dt * self._velocity
