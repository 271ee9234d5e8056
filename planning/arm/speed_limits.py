"""How fast a plan may move: the needle's tip, and the joints as a fraction of what the arm can."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from puncture_twin.planning.arm.ur import UrModel


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
