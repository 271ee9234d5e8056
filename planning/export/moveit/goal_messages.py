"""``control_msgs/action/FollowJointTrajectory`` goals, one for each phase: written, and read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.export.motion import SampledMotion, check_sampled
from puncture_twin.planning.export.ros2 import NANOSECONDS, TIME_RESOLUTION_S, velocities
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan

PATH_TOLERANCE_RAD, GOAL_TOLERANCE_RAD = 0.02, 0.002
"""Beyond them the controller gives up: on the way 20 mm at a metre, at the end 2 mm."""

GOAL_TIME_S = 1
"""How much later than planned the arm may arrive."""


def goal_messages(plan: Plan) -> dict[str, Any]:
    """``approach`` and ``insertion``."""
    return {phase: _goal(plan, getattr(plan, phase)) for phase in SampledMotion._fields}


def _goal(plan: Plan, trajectory: Trajectory) -> dict[str, Any]:
    speeds, names = velocities(plan.model, trajectory), plan.model.joint_names
    points = [_point(*row) for row in zip(trajectory.times_s, trajectory.q, speeds, strict=True)]
    return {
        "trajectory": {"header": {"frame_id": ""}, "joint_names": list(names), "points": points},
        "path_tolerance": [{"name": name, "position": PATH_TOLERANCE_RAD} for name in names],
        "goal_tolerance": [{"name": name, "position": GOAL_TOLERANCE_RAD} for name in names],
        "goal_time_tolerance": {"sec": GOAL_TIME_S, "nanosec": 0},
    }


def _point(time_s: float, q: Floats, speeds: Floats) -> dict[str, Any]:
    sec, nanosec = divmod(round(float(time_s) * NANOSECONDS), NANOSECONDS)
    return {
        "positions": q.tolist(),
        "velocities": speeds.tolist(),
        "time_from_start": {"sec": sec, "nanosec": nanosec},
    }


def check_goals(goals: Any, plan: Plan, *, where: Path) -> None:
    """Refuse goals that were read back and are not the plan's, or break a limit of the arm.

    Raises:
        InputError: Says what differs.
    """
    parts = {}
    for phase in SampledMotion._fields:
        trajectory = goals[phase]["trajectory"]
        if trajectory["joint_names"] != list(plan.model.joint_names):
            raise InputError(f"{phase} is of other joints", where=where, allowed=", ".join(plan.model.joint_names))
        starts = [point["time_from_start"] for point in trajectory["points"]]
        times = np.array([one["sec"] + one["nanosec"] / NANOSECONDS for one in starts])
        parts[phase] = Trajectory(times, np.array([point["positions"] for point in trajectory["points"]]))
    check_sampled(SampledMotion(**parts), plan, time_resolution_s=TIME_RESOLUTION_S, where=where)
