"""The exported numbers against the arm's limits: positions, speeds and accelerations."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.motion.trajectory import Trajectory

POSITION_SLACK_RAD = 1e-9
"""A printed angle may round beyond its limit by this."""

RELATIVE_SLACK = 1e-6
"""Rounding of printed speeds and of differences, as a fraction of the limit."""

ROUNDINGS = 8.0
"""Differences of differences of angles carry at most this many roundings of one angle."""


def check_positions(model: UrModel, q: Floats, *, what: str, where: Path) -> None:
    """Refuse angles outside the joints' limits.

    Args:
        model: The arm.
        q: Shape (m, 6), rad.
        what: The phase.
        where: The plan.

    Raises:
        InputError: Names the joint and the angle. NaN is outside.
    """
    inside = (q >= model.joint_limits[:, 0] - POSITION_SLACK_RAD) & (q <= model.joint_limits[:, 1] + POSITION_SLACK_RAD)
    if not inside.all():
        row, joint = np.argwhere(~inside)[0]
        low, high = np.degrees(model.joint_limits[joint])
        raise InputError(
            f"{what}: {model.joint_names[joint]} at {np.degrees(q[row, joint]):.3f} deg",
            where=where,
            allowed=f"{low:.0f} to {high:.0f} deg",
        )


def check_rates(model: UrModel, speeds: Floats, accelerations: Floats, *, what: str, where: Path) -> None:
    """Refuse speeds and accelerations above the limits.

    Args:
        model: The arm.
        speeds: Shape (m, 6), rad/s.
        accelerations: Shape (k, 6), rad/s^2.
        what: The phase.
        where: The plan.

    Raises:
        InputError: Names the joint, the rate and the limit. NaN is above.
    """
    for rates, limits, unit in (
        (speeds, model.max_speeds, "rad/s"),
        (accelerations, np.full(6, model.max_acceleration), "rad/s^2"),
    ):
        kept = np.abs(rates) <= limits * (1.0 + RELATIVE_SLACK)
        if not kept.all():
            row, joint = np.argwhere(~kept)[0]
            raise InputError(
                f"{what}: {model.joint_names[joint]} at {abs(rates[row, joint]):.6g} {unit}",
                where=where,
                allowed=f"at most {limits[joint]:.6g} {unit}",
            )


def check_trajectory(
    model: UrModel, trajectory: Trajectory, *, time_resolution_s: float, what: str, where: Path
) -> None:
    """Refuse samples outside any limit, by differences, from rest to rest.

    The mean speeds of neighbouring intervals differ by no more than the acceleration times the distance of their
    middles, so a motion within the limits is never refused, but for rounding, which is taken off here.

    Args:
        model: The arm.
        trajectory: The samples.
        time_resolution_s: To what the times were rounded; 0 for exact ones.
        what: The phase.
        where: The plan.

    Raises:
        InputError: Names joint, number and limit.
    """
    q, steps = trajectory.q, np.diff(trajectory.times_s)[:, None]
    check_positions(model, q, what=what, where=where)
    if len(q) == 1:
        return
    speeds = np.diff(q, axis=0) / steps
    change = np.diff(np.concatenate([np.zeros((1, 6)), speeds, np.zeros((1, 6))]), axis=0)
    between = (np.concatenate([np.zeros((1, 1)), steps]) + np.concatenate([steps, np.zeros((1, 1))])) / 2.0
    angle_rounding = ROUNDINGS * np.finfo(float).eps * max(1.0, float(np.abs(q).max()))
    blur = angle_rounding / steps + time_resolution_s * np.abs(speeds) / steps
    blur_between = np.maximum(np.concatenate([blur, blur[-1:]]), np.concatenate([blur[:1], blur])) * 2.0
    check_rates(
        model,
        np.maximum(np.abs(speeds) - blur, 0.0),
        np.maximum(np.abs(change) - blur_between, 0.0) / between,
        what=what,
        where=where,
    )
