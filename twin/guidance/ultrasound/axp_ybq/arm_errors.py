"""Errors of both arms that repeat from pose to pose: what is declared of them, and how they move the flanges.

An arm's true flange is its nominal one moved by J eta (Mooring, Roth, Driels 1991): eta are the errors of its 23
parameters (lengths, twists, joint zeros), which stay, and J follows from the joints. A calibration does not solve for
eta. It takes eta as normal with the declared deviations, and lets what the recording says of it correct the aim. In
addition the joints stop a little differently at each arrival: repeatability.

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

from puncture_twin.planning.arm.kinematics import PARAMETERS as ARM_PARAMETERS, check_flanges, error_jacobian
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.case.errors import ArmErrors
from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording

N_ARM = ARM_PARAMETERS["joint"].stop
"""Parameters of one arm that move its flange: 23. Those of the tip are unknowns of the calibration itself."""
PLAY_KNOWN = 0.25
"""Standard deviation of each joint's play, over the declared one."""


class DeclaredArm(NamedTuple):
    """One arm: its nominal model, and what is declared of its errors; half the play stops a joint short."""

    model: UrModel
    errors: ArmErrors

    def deviations(self) -> Floats:
        """Deviations of the 23 parameters, shape (23,), mm and rad."""
        sigma, errors = np.zeros(N_ARM), self.errors
        for kind, value in (("link", errors.link_mm), ("twist", errors.twist), ("joint", errors.joint)):
            sigma[ARM_PARAMETERS[kind]] = value
        return sigma

    def motions(self, q: Floats, turn: Floats) -> FlangeMotions:
        """Motions of the flange by the arm's errors at joints (n, 6), rad; ``turn`` (n, 6): last signs, 0 unknown."""
        J, half = error_jacobian(self.model, q, 0.0), self.errors.backlash / 2
        slopes, joints = J[..., :N_ARM] * self.deviations(), J[..., ARM_PARAMETERS["joint"]]
        play = -half * joints * turn[:, None, :]  # -half the width times the direction of rotation
        if half:
            slopes = np.concatenate([slopes, PLAY_KNOWN * play], axis=2)
        variance = self.errors.repeatability**2 + half**2 * (turn == 0.0)  # play is noise where its sign is unknown
        arrival = (joints * variance[:, None, :]) @ np.swapaxes(joints, -1, -2)
        return FlangeMotions(slopes, play.sum(axis=2), arrival)


class FlangeMotions(NamedTuple):
    """Motions of a flange at n poses by the errors of its arm: shift (mm) and rotation (rad) along the base's axes."""

    slopes: Floats  # shape (n, 6, 23), per standard deviation of each parameter; (n, 6, 29) with each joint's play
    play: Floats  # shape (n, 6), by the declared play from where the joints say
    arrival: Floats  # shape (n, 6, 6), the covariance between arrivals at one pose


class DeclaredArms(NamedTuple):
    """Declared errors of both arms."""

    probe: DeclaredArm
    needle: DeclaredArm


class FlangeErrors(NamedTuple):
    """Motions of both flanges of a recording by the errors of their arms."""

    probe: FlangeMotions
    needle: FlangeMotions


def arm_errors(declared: DeclaredArms, recording: Recording) -> FlangeErrors:
    """The errors of declared arms at a recording's joints.

    Raises:
        InputError: Joints that the recording has not, or that do not belong to its flanges.
    """
    r = recording
    if r.q_probe is None or r.q_needle is None:
        refuse("the arms' errors need the joints", "recording", "columns A_q1_deg to B_q6_deg", "missing_column")
    motions = []
    for arm, q, T, turn, of in (
        (declared.probe, r.q_probe, r.A, r.turn_probe, "A"),
        (declared.needle, r.q_needle, r.B, r.turn_needle, "B"),
    ):
        check_flanges(arm.model, q, T, names=[f"{of} in pose {name}" for name in r.names], where="recording")
        motions.append(arm.motions(q, np.zeros(q.shape) if turn is None else turn))
    return FlangeErrors(*motions)


def corrected(T_base_flange: Floats, motion: Floats) -> Floats:
    """Flange poses (n, 4, 4) after a small shift and turn (n, 6) along the base's axes, about the flange's origin."""
    T = np.array(T_base_flange)
    T[..., :3, :3] = exp_rotation(motion[..., 3:]) @ T[..., :3, :3]
    T[..., :3, 3] += motion[..., :3]
    return T


def without_play(recording: Recording, errors: FlangeErrors) -> Recording:
    """The recording with its flanges where the declared play leaves them."""
    if not (errors.probe.play.any() or errors.needle.play.any()):
        return recording
    A, B = corrected(recording.A, errors.probe.play), corrected(recording.B, errors.needle.play)
    return replace(recording, A=A, B=B)
