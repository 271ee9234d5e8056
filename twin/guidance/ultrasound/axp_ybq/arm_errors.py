"""Errors of both arms that repeat from pose to pose: wrong lengths, twists and joint zeros, and what differs each time.

An arm's flange stands where its nominal numbers say, moved by J eta (Mooring, Roth, Driels 1991): eta are the errors of
its 23 parameters, which stay, and J follows from the joints. A calibration does not ask for eta. It takes eta as normal
with the declared deviations, and lets what the recording says of it correct the aim. Beside eta the joints stop a
little differently at each arrival: repeatability, and play, which leaves a joint at either edge of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.error_jacobian import PARAMETERS, error_jacobian
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.rigid import exp_rotation, log_rotation
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording

N_ARM = PARAMETERS["joint"].stop
"""Parameters of one arm that move its flange: 23. Those of the tip are unknowns of the calibration itself."""

N_BOTH = 2 * N_ARM

FAR_MM, FAR_RAD = 20.0, float(np.radians(3.0))
"""A recorded flange that is farther from what the joints give belongs to another arm, or is no flange."""


class DeclaredArm(NamedTuple):
    """One arm: its nominal model, and standard deviations in mm and rad."""

    model: UrModel
    link_mm: float
    """Of every Denavit-Hartenberg length."""
    twist_rad: float
    """Of every twist."""
    joint_rad: float
    """Of every joint's zero."""
    arrival_rad: float
    """Of every joint, anew at each arrival."""

    def deviations(self) -> Floats:
        """Of the 23 parameters, shape (23,)."""
        sigma = np.zeros(N_ARM)
        for kind, value in (("link", self.link_mm), ("twist", self.twist_rad), ("joint", self.joint_rad)):
            sigma[PARAMETERS[kind]] = value
        return sigma

    def flange_slopes(self, q: Floats) -> Floats:
        """Shift (mm) and turn (rad) of the flange per standard deviation of each parameter, shape (n, 6, 23), base."""
        return np.asarray(error_jacobian(self.model, q, 0.0)[..., :N_ARM] * self.deviations())

    def arrival_covariance(self, q: Floats) -> Floats:
        """Of the flange's shift and turn between arrivals at one pose, shape (n, 6, 6)."""
        J = error_jacobian(self.model, q, 0.0)[..., PARAMETERS["joint"]]
        return np.asarray(self.arrival_rad**2 * J @ np.swapaxes(J, -1, -2))


class DeclaredArms(NamedTuple):
    """Both arms."""

    probe: DeclaredArm
    needle: DeclaredArm

    def scaled(self, factor: float) -> DeclaredArms:
        """Each deviation of both arms times a factor."""
        return DeclaredArms(*(DeclaredArm(arm.model, *(factor * value for value in arm[1:])) for arm in self))


class ArmErrors(NamedTuple):
    """How both arms' errors move the flanges of a recording."""

    probe: Floats
    """Shape (n, 6, 23), per standard deviation."""
    needle: Floats
    """Shape (n, 6, 23), per standard deviation."""
    probe_arrival: Floats
    """Covariance, shape (n, 6, 6)."""
    needle_arrival: Floats
    """Covariance, shape (n, 6, 6)."""


def arm_errors(declared: DeclaredArms, recording: Recording) -> ArmErrors:
    """The errors of declared arms at a recording's joints.

    Raises:
        InputError: Joints that the recording has not, or that do not belong to its flanges.
    """
    q_probe, q_needle = recording.q_probe, recording.q_needle
    if q_probe is None or q_needle is None:
        raise InputError("the arms' errors need the joints", where="recording", allowed="columns A_q1_deg to B_q6_deg")
    _check_joints(declared.probe.model, q_probe, recording.A, "A", recording.names)
    _check_joints(declared.needle.model, q_needle, recording.B, "B", recording.names)
    return ArmErrors(
        declared.probe.flange_slopes(q_probe),
        declared.needle.flange_slopes(q_needle),
        declared.probe.arrival_covariance(q_probe),
        declared.needle.arrival_covariance(q_needle),
    )


def corrected(T_base_flange: Floats, motion: Floats) -> Floats:
    """Flange poses (n, 4, 4) after a small shift and turn (n, 6) along the base's axes, about the flange's origin."""
    T = np.array(T_base_flange)
    T[..., :3, :3] = exp_rotation(motion[..., 3:]) @ T[..., :3, :3]
    T[..., :3, 3] += motion[..., :3]
    return T


def _check_joints(model: UrModel, q: Floats, T: Floats, name: str, poses: tuple[str, ...]) -> None:
    nominal = flange_pose(model, q)
    shift = np.linalg.norm(nominal[:, :3, 3] - T[:, :3, 3], axis=1)
    turn = np.linalg.norm(log_rotation(nominal[:, :3, :3].transpose(0, 2, 1) @ T[:, :3, :3]), axis=1)
    bad = (shift > FAR_MM) | (turn > FAR_RAD)
    if bad.any():
        row = int(np.argmax(bad))
        what = (
            f"joints of {name} in pose {poses[row]}: a {model.name} with them has its flange {shift[row]:.3g} mm and "
            f"{np.degrees(turn[row]):.2g} deg from {name}"
        )
        raise InputError(what, where="recording", allowed=f"flanges within {FAR_MM:g} mm and 3 deg of their joints")
