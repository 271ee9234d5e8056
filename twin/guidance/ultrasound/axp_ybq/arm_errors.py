"""Errors of both arms: lengths, twists and joint zeros that repeat from pose to pose, and what differs each time.

An arm's true flange is its nominal one moved by J eta (Mooring, Roth, Driels 1991): eta are the errors of its 23
parameters, which stay, and J follows from the joints. A calibration does not solve for eta. It takes eta as normal
with the declared deviations, and lets what the recording says of it correct the aim. In addition the joints stop a
little differently at each arrival: repeatability.

Play leaves a joint half of its width b short of where it was sent. Which way the joint rotated says the sign (the play
operator: Visintin, Differential Models of Hysteresis, 1994, chapter III):

    q = q_sent - s b (1 + c z) / 2,   s = 1 or -1,   z normal, c = PLAY_KNOWN.

b / 2 moves the recorded flanges beforehand, and c z is one more error per joint that stays. Where s is unknown, play
is an arrival's noise of variance (b / 2)^2.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import PARAMETERS, check_flanges, error_jacobian
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording

N_ARM = PARAMETERS["joint"].stop
"""Parameters of one arm that move its flange: 23. Those of the tip are unknowns of the calibration itself."""

PLAY_KNOWN = 0.25
"""Standard deviation of each joint's play, over the declared one."""


class DeclaredArm(NamedTuple):
    """One arm: its nominal model, and standard deviations in mm and rad."""

    model: UrModel
    link_mm: float
    """Deviation of every Denavit-Hartenberg length."""
    twist_rad: float
    """Deviation of every twist."""
    joint_rad: float
    """Deviation of every joint's zero."""
    arrival_rad: float
    """Deviation of every joint, anew at each arrival."""
    play_rad: float = 0.0
    """Half the width of every joint's play: how far it stops short of where it was sent; no deviation."""

    def deviations(self) -> Floats:
        """Deviations of the 23 parameters, shape (23,), mm and rad."""
        sigma = np.zeros(N_ARM)
        for kind, value in (("link", self.link_mm), ("twist", self.twist_rad), ("joint", self.joint_rad)):
            sigma[PARAMETERS[kind]] = value
        return sigma

    def flange_slopes(self, q: Floats, turn: Floats) -> Floats:
        """Shift (mm) and turn (rad) of the flange per standard deviation of each parameter, shape (n, 6, 23), base.

        With play (n, 6, 29): six more parameters are by how much each joint's play differs from the declared one.

        Args:
            q: Joints, shape (n, 6), rad.
            turn: Direction in which each last rotated, shape (n, 6): 1, -1, or 0 where unknown.
        """
        slopes = error_jacobian(self.model, q, 0.0)[..., :N_ARM] * self.deviations()
        if self.play_rad:
            slopes = np.concatenate([slopes, PLAY_KNOWN * self._play_slopes(q, turn)], axis=2)
        return np.asarray(slopes)

    def play_motion(self, q: Floats, turn: Floats) -> Floats:
        """Motion of the flange by the declared play from where its joints say, shape (n, 6); arguments as above."""
        return np.asarray(self._play_slopes(q, turn).sum(axis=2))

    def _play_slopes(self, q: Floats, turn: Floats) -> Floats:
        """Slopes of each joint's play: -half the width times the direction in which it rotated."""
        J = error_jacobian(self.model, q, 0.0)[..., PARAMETERS["joint"]]
        return np.asarray(-self.play_rad * J * turn[:, None, :])

    def arrival_covariance(self, q: Floats, turn: Floats) -> Floats:
        """Covariance of the flange between arrivals at one pose, shape (n, 6, 6), mm and rad; arguments as above."""
        J = error_jacobian(self.model, q, 0.0)[..., PARAMETERS["joint"]]
        variance = self.arrival_rad**2 + self.play_rad**2 * (turn == 0.0)  # play is noise where its sign is unknown
        return np.asarray((J * variance[:, None, :]) @ np.swapaxes(J, -1, -2))


class DeclaredArms(NamedTuple):
    """Declared errors of both arms."""

    probe: DeclaredArm
    needle: DeclaredArm

    def scaled(self, factor: float) -> DeclaredArms:
        """Each deviation of both arms times a factor."""
        return DeclaredArms(*(DeclaredArm(arm.model, *(factor * value for value in arm[1:])) for arm in self))


class ArmErrors(NamedTuple):
    """How both arms' errors move the flanges of a recording."""

    probe: Floats
    """Shape (n, 6, 23), motion per standard deviation of the probe's arm; (n, 6, 29) where play is declared."""
    needle: Floats
    """The motion by the needle's arm, likewise shaped."""
    probe_play: Floats
    """How the declared play moves the flange, shape (n, 6)."""
    needle_play: Floats
    """How the play of the needle's arm moves its flange, shape (n, 6)."""
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
        refuse("the arms' errors need the joints", "recording", "columns A_q1_deg to B_q6_deg", "missing_column")
    for arm, q, T, of in ((declared.probe, q_probe, recording.A, "A"), (declared.needle, q_needle, recording.B, "B")):
        names = [f"{of} in pose {name}" for name in recording.names]
        check_flanges(arm.model, q, T, names=names, where="recording")
    unknown = np.zeros(q_probe.shape)
    turn_probe = unknown if recording.turn_probe is None else recording.turn_probe
    turn_needle = unknown if recording.turn_needle is None else recording.turn_needle
    return ArmErrors(
        declared.probe.flange_slopes(q_probe, turn_probe),
        declared.needle.flange_slopes(q_needle, turn_needle),
        declared.probe.play_motion(q_probe, turn_probe),
        declared.needle.play_motion(q_needle, turn_needle),
        declared.probe.arrival_covariance(q_probe, turn_probe),
        declared.needle.arrival_covariance(q_needle, turn_needle),
    )


def corrected(T_base_flange: Floats, motion: Floats) -> Floats:
    """Flange poses (n, 4, 4) after a small shift and turn (n, 6) along the base's axes, about the flange's origin."""
    T = np.array(T_base_flange)
    T[..., :3, :3] = exp_rotation(motion[..., 3:]) @ T[..., :3, :3]
    T[..., :3, 3] += motion[..., :3]
    return T


def without_play(recording: Recording, errors: ArmErrors) -> Recording:
    """The recording with its flanges where the declared play leaves them."""
    return replace(recording, A=corrected(recording.A, errors.probe_play), B=corrected(recording.B, errors.needle_play))
