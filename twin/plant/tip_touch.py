"""Touching markers with the needle's tip and reading the controller's position (spec 1, section 3; Chen 2019, 3.2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose, inverse, singularity
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.geometry.rigid import frame_about, pose

TILTS_DEG = (0.0, 15.0, 30.0, 45.0, 60.0)
"""How far the needle may lean from the wished direction, tried in this order."""

AZIMUTHS = 12
"""Sides to which it may lean."""

LEAST_SINGULARITY = 0.05
"""A pose nearer than this to a singularity is not used to measure (of 0..1)."""


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
        q_encoder = touching_configuration(probe, point) - probe.joint_offsets
        readings.append((flange_pose(probe.model, q_encoder) @ tip)[:3])
    return np.array(readings) + rng.normal(0.0, probe.noise_mm, (len(readings), 3))


def touching_configuration(probe: TouchProbe, point_base: Floats) -> Floats:
    """True joint angles that hold the tip on a point, shape (6,), rad: the least tilt, then the farthest from singular.

    Raises:
        NoAnswerError: There are none in the tried directions.
    """
    for tilt in np.radians(TILTS_DEG):
        q = np.concatenate([inverse(probe.model, pose)[0] for pose in _touching_poses(probe, point_base, float(tilt))])
        q = q[probe.model.within_limits(q)]
        room = singularity(probe.model, q).least()
        if len(q) and room.max() >= LEAST_SINGULARITY:
            return np.asarray(q[int(np.argmax(room))])
    place = ", ".join(f"{value:.1f}" for value in point_base)
    raise NoAnswerError(f"a {probe.model.name} cannot touch ({place}) mm with a needle of {probe.tcp_mm:g} mm")


def _touching_poses(probe: TouchProbe, point_base: Floats, tilt: float) -> list[Floats]:
    """Flange poses with the tip on the point, leaning by ``tilt`` to every side."""
    frame = frame_about(probe.needle_base)
    sides = np.linspace(0, 2 * np.pi, AZIMUTHS, endpoint=False) if tilt > 0 else [0.0]
    poses = []
    for side in sides:
        lean = [np.sin(tilt) * np.cos(side), np.sin(tilt) * np.sin(side), np.cos(tilt)]
        R = frame_about(frame @ np.array(lean))  # any roll will do: it is q6 alone
        poses.append(pose(R, point_base - probe.tcp_mm * R[:, 2]))
    return poses
