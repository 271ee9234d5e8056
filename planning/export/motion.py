"""What a file of samples says: both phases over time. And whether that is what the plan says."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.export.limits import check_trajectory
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan

ANGLE_TOLERANCE_RAD = 1e-9
"""How far an angle that was read back may be from the plan's."""

TIME_TOLERANCE_S = 1e-9
"""How far a time that was read back may be from the plan's: ROS counts nanoseconds, which is half of one at most."""


class SampledMotion(NamedTuple):
    """Both phases as samples, each from time 0."""

    approach: Trajectory
    insertion: Trajectory


def check_sampled(motion: SampledMotion, plan: Plan, *, time_resolution_s: float, where: Path) -> None:
    """Refuse samples that are not the plan's, or that break a limit.

    Args:
        motion: What was read back.
        plan: What was exported.
        time_resolution_s: To what the format rounds times; 0 for exact ones.
        where: The plan's file.

    Raises:
        InputError: Says what differs or which limit is broken.
    """
    for name in SampledMotion._fields:
        read, planned = getattr(motion, name), getattr(plan, name)
        same = (
            read.q.shape == planned.q.shape
            and np.abs(read.q - planned.q).max() <= ANGLE_TOLERANCE_RAD
            and np.abs(read.times_s - planned.times_s).max() <= TIME_TOLERANCE_S
        )
        if not same:
            raise InputError(f"the {name} does not read back as the plan's", where=where, allowed="the plan's samples")
        check_trajectory(plan.model, read, time_resolution_s=time_resolution_s, what=name, where=where)
