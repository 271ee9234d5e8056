"""Configurations in which an arm can touch a point with its needle's tip."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.singularity import farthest_from_singular, singularity
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.geometry.frames import frame_about
from puncture_twin.planning.geometry.rigid import pose

TILTS_DEG = (0.0, 15.0, 30.0, 45.0, 60.0)
"""How far the needle may lean from the wished direction, tried in this order."""

AZIMUTHS = 12
"""Sides to which it may lean."""

LEAST_SINGULARITY = 0.05
"""A pose nearer than this to a singularity is not used to measure (of 0..1)."""


def touching_configuration(model: UrModel, tip_mm: float, point_base: Floats, needle_base: Floats) -> Floats:
    """Joint angles that put the tip on a point, shape (6,), rad: the least tilt, then the farthest from singular.

    Of equals the one with its elbow on the side from which the needle comes: mirrored branches are equal.

    Args:
        model: The arm.
        tip_mm: Flange to tip, along the flange's z.
        point_base: Shape (3,), mm.
        needle_base: Shape (3,), unit: the wished direction from the needle's top to its tip.

    Raises:
        NoAnswerError: There are none in the tried directions.
    """
    for tilt in np.radians(TILTS_DEG):
        poses = touching_poses(tip_mm, point_base, needle_base, float(tilt))
        q = np.concatenate([inverse(model, T)[0] for T in poses])
        q = q[model.within_limits(q)]
        if len(q) and singularity(model, q).least().max() >= LEAST_SINGULARITY:
            return farthest_from_singular(model, q, -needle_base)
    place = ", ".join(f"{value:.1f}" for value in point_base)
    raise NoAnswerError(f"a {model.name} cannot touch ({place}) mm with a needle of {tip_mm:g} mm")


def touching_poses(tip_mm: float, point_base: Floats, needle_base: Floats, tilt: float) -> list[Floats]:
    """Flange poses (4, 4) with the tip on a point, leaning by ``tilt`` (rad) to every side; arguments as above."""
    frame = frame_about(needle_base)
    sides = np.linspace(0, 2 * np.pi, AZIMUTHS, endpoint=False) if tilt > 0 else [0.0]
    poses = []
    for side in sides:
        lean = [np.sin(tilt) * np.cos(side), np.sin(tilt) * np.sin(side), np.cos(tilt)]
        R = frame_about(frame @ np.array(lean))  # any roll will do: it is q6 alone
        poses.append(pose(R, point_base - tip_mm * R[:, 2]))
    return poses
