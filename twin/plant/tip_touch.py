"""Touching markers with the needle's tip and reading the controller's position (spec 1, section 3; Chen 2019, 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.registration.touch_poses import touching_configuration


@dataclass(frozen=True, eq=False)
class TouchProbe:
    """The robot as a measuring device.

    Attributes:
        model: The arm.
        tcp_mm: Tip to flange along the flange's z, as told to the controller.
        needle_base: Shape (3,), wished direction of the needle, base frame, unit.
        noise_mm: Standard deviation per axis of one touch: control and needle together.
        joint_offsets: Shape (6,), rad: true joint angle minus what the encoder says.
    """

    model: UrModel
    tcp_mm: float
    needle_base: Floats
    noise_mm: float
    joint_offsets: Floats


def touch(probe: TouchProbe, points_base: Floats, rng: np.random.Generator) -> Floats:
    """Drive the true tip to each point and read what the controller says.

    Args:
        probe: The robot.
        points_base: True positions, shape (n, 3), mm, base frame.
        rng: Draws the noise of each touch.

    Returns:
        Readings, shape (n, 3), mm, base frame.

    Raises:
        NoAnswerError: The arm cannot reach a point in any of the tried directions.
    """
    tip = np.array([0.0, 0.0, probe.tcp_mm, 1.0])
    readings = []
    for point in points_base:
        q_true = touching_configuration(probe.model, probe.tcp_mm, point, probe.needle_base)
        q_encoder = q_true - probe.joint_offsets
        readings.append((flange_pose(probe.model, q_encoder) @ tip)[:3])
    return np.array(readings) + rng.normal(0.0, probe.noise_mm, (len(readings), 3))
