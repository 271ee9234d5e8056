"""How fast a plan may move: the needle's tip, and the joints as a fraction of what the arm can."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose, jacobian
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats


class SpeedLimits(NamedTuple):
    """What a case allows, and its plan keeps. The names are the keys of ``[robot]``."""

    tip_speed_mm_s: float = 250.0
    """Of the needle's tip, on the approach: what ISO 10218-1 calls reduced speed."""

    insertion_speed_mm_s: float = 10.0
    """Of the tip, along the insertion: a needle is inserted slowly, and an operator must be able to stop it."""

    joint_speed_fraction: float = 0.5
    """Of each joint's highest speed, as MoveIt's velocity scaling."""

    joint_acceleration_fraction: float = 1.0
    """Of each joint's highest acceleration, as MoveIt's acceleration scaling."""


DEFAULT_SPEEDS = SpeedLimits()
"""Where nobody says how fast."""

HIGHEST = SpeedLimits(1000.0, 100.0, 1.0, 1.0)
"""That a case may ask for: a UR's usual tool speed, a needle that is pushed briskly, and all that the joints can."""


def slowed(model: UrModel, speeds: SpeedLimits) -> UrModel:
    """The arm with its joints' speed and acceleration limits cut down to the fractions."""
    return replace(
        model,
        max_speeds=speeds.joint_speed_fraction * model.max_speeds,
        max_acceleration=speeds.joint_acceleration_fraction * model.max_acceleration,
    )


class TipLimit(NamedTuple):
    """The highest speed of a point on the flange's z axis."""

    tip_mm: float
    """Flange to tip."""

    speed_mm_s: float


def tip_rates(model: UrModel, q: Floats, directions: Floats, tip_mm: float) -> Floats:
    """How fast the tip moves while the joints move at given speeds: |J_v u + (J_w u) x l z|, l from flange to tip.

    Args:
        model: The arm.
        q: Shape (m, 6), rad.
        directions: Shape (m, 6) or (6,), u: joint speeds, rad/s; or per whatever else the tip's speed is then per.
        tip_mm: Flange to tip, along the flange's z.

    Returns:
        Shape (m,), mm/s.
    """
    twists = np.einsum("mij,mj->mi", jacobian(model, q), np.broadcast_to(directions, q.shape))
    lever = tip_mm * flange_pose(model, q)[:, :3, 2]
    return np.asarray(np.linalg.norm(twists[:, :3] + np.cross(twists[:, 3:], lever), axis=1))


def tip_speeds(model: UrModel, q: Floats, times_s: Floats, tip_mm: float) -> Floats:
    """The tip's mean speed between the samples of a motion, mm/s.

    Args:
        model: The arm.
        q: Shape (m, 6), rad.
        times_s: Shape (m,), s, rising.
        tip_mm: Flange to tip, along the flange's z.

    Returns:
        Shape (m - 1,).
    """
    poses = flange_pose(model, q)
    tips = poses[:, :3, 3] + tip_mm * poses[:, :3, 2]
    return np.asarray(np.linalg.norm(np.diff(tips, axis=0), axis=1) / np.diff(times_s))
