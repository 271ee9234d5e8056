"""A tip that yields by moving the position motors' goals: admittance, the form that the paper's words end in.

    M_a x'' + D_a x' + K_a x = F,   q_command = q_ref + J^-1 x

F is the force felt at the tip. Between force and motion lie the motors' own stiffness and lag: against a rigid body the
loop oscillates; against a soft one it settles at F / K_a.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.world.control.reference import Reference
from puncture_twin.twin.world.control.run import Goals, Measured
from puncture_twin.twin.world.control.tip import tips

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
