"""A spring and a damper at the needle's tip, by joint torques (Hogan 1985).

    tau = ID(q, qd, qdd_ref) + J' (K e + D de/dt + K_i K int e dt)

e is the reference's tip minus the measured one: position, then the rotation between them, in base axes. Without
contact the model's torque alone follows the reference and the spring corrects what the masses err by; in contact the
tip yields by F / K. The integral takes the rest away, and with it, in 1/K_i seconds, the compliance: it stands still
while contact is felt, where the compliance is to be kept.
"""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.world.control.gains import Stiffness, damping, refuse_unstable
from puncture_twin.twin.world.control.reference import Reference
from puncture_twin.twin.world.control.rigid_model import RigidModel
from puncture_twin.twin.world.control.run import Measured, Torques
from puncture_twin.twin.world.control.tip import tips

REFRESH_STEPS = 5
"""Between two evaluations of the tip's mass and the damping that follows from it: the pose changes slowly."""

CONTACT_N = 0.5
"""A force at the tip above which there is contact."""


class Impedance:
    """The controller: it keeps the integral of its error and the damping of its pose.

    Args:
        model: Of the arm's masses.
        stiffness: At the tip.
        dt: Its step, s.
        keep_compliance: Whether the integral stands still while contact is felt.
    """

    def __init__(self, model: RigidModel, stiffness: Stiffness, dt: float, *, keep_compliance: bool = True) -> None:
        self.dt = dt
        self._model, self._stiffness = model, stiffness
        self._keep_compliance = keep_compliance
        self._K = stiffness.diagonal
        self._integral, self._D = np.zeros(6), np.zeros((6, 6))
        self._steps = 0

    def act(self, measured: Measured, reference: Reference, row: int) -> Torques:
        """Torques for the next step.

        Raises:
            InputError: The stiffness would diverge at this pose.
        """
        tip = tips(self._model.kinematics, self._model.tip_m, measured.q[None])
        J = tip.J[0]
        if self._steps % REFRESH_STEPS == 0:
            M = self._model.mass_matrix(measured.q)
            refuse_unstable(self._stiffness, J, M, self.dt)
            self._D = damping(self._stiffness, J, M)
        self._steps += 1
        turn = rotation_error(reference.R_base_tip[row], tip.R_base_tip[0])
        error = np.concatenate([reference.position_m[row] - tip.position_m[0], turn])
        if not (self._keep_compliance and np.linalg.norm(measured.force_n) > CONTACT_N):
            self._integral = self._integral + self.dt * error
        spring = self._K * (error + self._stiffness.integral_per_s * self._integral)
        wrench = spring + self._D @ (reference.twist[row] - J @ measured.speed)
        feedforward = self._model.inverse_dynamics(measured.q, measured.speed, reference.acceleration[row])
        return Torques(feedforward + J.T @ wrench)


def rotation_error(R_reference: Floats, R: Floats) -> Floats:
    """From R to the reference, shape (3,), rad: sin(angle) along the axis, half the sum of r_i x r_reference_i.

    Source: Luh, Walker, Paul 1980, "Resolved-acceleration control of mechanical manipulators".
    """
    skewed = R_reference @ R.T
    return 0.5 * np.array([skewed[2, 1] - skewed[1, 2], skewed[0, 2] - skewed[2, 0], skewed[1, 0] - skewed[0, 1]])
