"""The workcell in which a recording is made: two arms as they move, the mounts, the needle."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.ultrasound.image.probe_image import NeedleInImage
from puncture_twin.twin.guidance.ultrasound.pose_choice import needle_flange

JOG_STEPS = 4
"""Of the operator's correction: each leaves about the arms' relative error, 1e-3, of what was left before."""


class MovingArm(Protocol):
    """An arm that is commanded by its nominal model and moves as it does; the plant has one, drawn."""

    @property
    def nominal(self) -> UrModel:
        """What is believed of it."""

    @property
    def backlash_rad(self) -> float:
        """Full width of the play of every joint."""

    def flange_pose(self, q_true: Floats) -> Floats:
        """T_base_flange, shape (..., 4, 4), mm, of true configurations (..., 6), rad."""

    def settle(self, q_command: Floats, q_before: Floats, rng: np.random.Generator) -> Floats:
        """Where the joints come to rest, shape (6,), rad, after those of the arrival before."""


class WorkcellTruth(NamedTuple):
    """The ground truth of one workcell: whoever calibrates must not look in here."""

    probe_arm: MovingArm
    needle_arm: MovingArm
    X: Floats
    """T_end1_image, shape (4, 4), mm."""
    Y: Floats
    """T_base1_base2, shape (4, 4), mm."""
    tip_end2: Floats
    """Shape (3,), mm."""
    V: Floats
    """The needle's direction in end2, shape (3,), unit."""

    def image_pose(self, q_probe: Floats) -> Floats:
        """The true T_base1_image, shape (4, 4), mm, of the probe's arm at rest at ``q_probe`` (6,), rad."""
        return np.asarray(self.probe_arm.flange_pose(q_probe) @ self.X)

    def needle_in_image(self, q_probe: Floats, q_needle: Floats) -> NeedleInImage:
        """The true needle in the true image, both arms at rest."""
        T = np.linalg.inv(self.image_pose(q_probe)) @ self.Y @ self.needle_arm.flange_pose(q_needle)
        direction = T[:3, :3] @ self.V
        return NeedleInImage(T[:3, :3] @ self.tip_end2 + T[:3, 3], direction / np.linalg.norm(direction))


def jog_into_slice(
    truth: WorkcellTruth, q_probe: Floats, q_needle: Floats, wanted: NeedleInImage, roll: float
) -> Floats:
    """Move the needle's arm until the true needle is in the true image as wanted.

    It stands for the operator, or a servo on the picture, that jogs until the needle shows: what is left is in
    ``wanted``. The commands follow from the nominal kinematics, corrected by what the true arm did before.

    Args:
        truth: The room.
        q_probe: Where the probe's joints rest, shape (6,), rad.
        q_needle: Where the needle's arm begins, shape (6,), rad.
        wanted: The needle in the image, after the jog.
        roll: About the needle, rad.

    Returns:
        What the arm is commanded, shape (6,), rad; NaN where no configuration reaches it.
    """
    nominal = truth.needle_arm.nominal
    T_base2_image = (np.linalg.inv(truth.Y) @ truth.image_pose(q_probe))[None]
    tip, along = wanted.tip_image[None], wanted.direction_image[None]
    goal = needle_flange(T_base2_image, tip, along, np.array([roll]), truth.tip_end2, truth.V)[0]
    command, q = goal, np.array(q_needle)
    for _ in range(JOG_STEPS):
        q = nearest_configuration(truth.needle_arm, command, q)
        if np.isnan(q).any():
            return q
        command = flange_pose(nominal, q) @ np.linalg.inv(truth.needle_arm.flange_pose(q)) @ goal
    return q


def nearest_configuration(arm: MovingArm, T_base_flange: Floats, q_near: Floats) -> Floats:
    """The nominal arm's configuration for a flange pose that is nearest to another, shape (6,), rad; NaN for none."""
    q = nearest_within_limits(arm.nominal, inverse(arm.nominal, T_base_flange)[0], q_near)
    away = np.linalg.norm(q - q_near, axis=1)
    return np.array(q[int(np.argmin(np.where(np.isnan(away), np.inf, away)))])
