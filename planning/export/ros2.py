"""The plan as two ``trajectory_msgs/JointTrajectory`` messages in YAML, one for each phase."""

import re
from pathlib import Path

import numpy as np

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.export.program import SampledMotion, check_rates, corner_rows, heading, rests_at
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan

NANOSECONDS = 1_000_000_000
LONGEST_S = 2**31 - 1
"""Longest time, s: ``sec`` is a signed 32-bit integer."""
TIME_RESOLUTION_S = 1.0 / NANOSECONDS
MONOTONE = 3.0
"""A cubic between two samples stays between them if its end slopes are at most this many times the chord's (Fritsch
and Carlson, "Monotone piecewise cubic interpolation", 1980)."""
NOTES = (
    "two trajectory_msgs/JointTrajectory: send 'approach', wait for the operator at standoff, then send 'insertion'",
    "joint angles are the same for ROS and for the controller; base_link of ur_description is the controller's base",
    "rotated by 180 deg about z; this matters only for Cartesian poses: there are none here, and frame_id is empty",
    "the arm must be at the first positions before the approach is sent: check it",
)
_POINT = re.compile(
    r"    - \{positions: \[(.+)\], velocities: \[(.+)\], time_from_start: \{sec: (\d+), nanosec: (\d+)\}\}"
)


def ros2_text(plan: Plan, *, case_checked: bool) -> str:
    """One YAML mapping with the messages ``approach`` and ``insertion``."""
    lines = heading(plan, NOTES, case_checked=case_checked)
    for phase in SampledMotion._fields:
        lines += [
            f"{phase}:",
            "  header: {stamp: {sec: 0, nanosec: 0}, frame_id: ''}",
            f"  joint_names: [{', '.join(plan.model.joint_names)}]",
            "  points:",
        ]
        part: Trajectory = getattr(plan, phase)
        for time, q, speeds in zip(part.times_s, part.q, velocities(plan.model, part), strict=True):
            sec, nanosec = divmod(round(float(time) * NANOSECONDS), NANOSECONDS)
            at = f"time_from_start: {{sec: {sec}, nanosec: {nanosec}}}"
            lines.append(f"    - {{positions: {_floats(q)}, velocities: {_floats(speeds)}, {at}}}")
    return "\n".join(lines) + "\n"


def _floats(row: Floats) -> str:
    """Exact floats, each with a point: YAML 1.1 takes ``1e-05`` for a word and ``3`` for an integer."""
    texts = [repr(value) for value in row.tolist()]
    return f"[{', '.join(t if '.' in t else t.replace('e', '.0e') for t in texts)}]"


def velocities(model: UrModel, trajectory: Trajectory) -> Floats:
    """Speeds (m, 6), rad/s, by differences: 0 at the ends, where the arm rests, and where a joint turns back.

    Of three parabolas through a sample and two neighbours (both before, one on each side, both after) at least two have
    the motion's own slope when its acceleration changes at samples only, and not at two in a row: the middle one of the
    three slopes is taken. It is kept within what keeps a cubic through the samples between its neighbours.
    """
    speeds = np.zeros_like(trajectory.q)
    if len(speeds) < 3:
        return speeds
    steps = np.diff(trajectory.times_s)[:, None]
    slopes = np.diff(trajectory.q, axis=0) / steps
    before, after = slopes[:-1], slopes[1:]
    bends = np.diff(slopes, axis=0) / (steps[1:] + steps[:-1])
    around = before + steps[:-1] * bends
    behind, ahead = around.copy(), around.copy()
    behind[1:] = slopes[1:-1] + steps[1:-1] * bends[:-1]
    ahead[:-1] = slopes[1:-1] - steps[1:-1] * bends[1:]
    middle = np.median(np.stack([behind, around, ahead]), axis=0)
    most = MONOTONE * np.minimum(np.abs(before), np.abs(after))
    speeds[1:-1] = np.where(before * after > 0.0, np.clip(middle, -most, most), 0.0)
    corners = corner_rows(trajectory.q)[1:-1]
    if rests_at(model, trajectory, corners):
        speeds[corners] = 0.0
    return speeds


def read_ros2(text: str, model: UrModel, *, where: Path) -> SampledMotion:
    """Read the messages back, line by line as they are written; speeds are compared with the limits.

    Raises InputError: any line that is not one of this layout's, other joints, or points that are no motion.
    """
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    parts: dict[str, Trajectory] = {}
    for phase in SampledMotion._fields:
        joints = f"  joint_names: [{', '.join(model.joint_names)}]"
        if lines[:1] != [f"{phase}:"] or lines[2:4] != [joints, "  points:"]:
            refuse(f"no message '{phase}' of the six joints", where, "approach, insertion", "missing_message")
        lines = lines[4:]
        points = []
        while lines and (match := _POINT.fullmatch(lines[0])):
            points.append(match.groups())
            lines = lines[1:]
        try:
            parts[phase] = _trajectory(points, model, phase, where)
        except ValueError as error:
            allowed = "six positions and velocities a point"
            raise InputError(f"{phase}: {error}", where=where, allowed=allowed, code="bad_value") from error
    if lines:
        refuse(f"line {lines[0]!r:.80}", where, "points of two messages", "wrong_format")
    return SampledMotion(**parts)


def _trajectory(points: list[tuple[str, ...]], model: UrModel, phase: str, where: Path) -> Trajectory:
    times = np.array([int(sec) + int(nanosec) / NANOSECONDS for _, _, sec, nanosec in points])
    if len(times) and times[-1] > LONGEST_S:
        refuse(f"{phase} of {times[-1]:.3g} s", where, f"at most {LONGEST_S} s", "too_long")
    if len(times) == 0 or times[0] != 0.0 or (np.diff(times) <= 0.0).any():
        allowed = "times that rise from 0 by whole nanoseconds"
        refuse(f"{phase}: two samples within a nanosecond, or none at time 0", where, allowed, "times_not_rising")
    q, speeds = (np.array([[float(x) for x in point[k].split(",")] for point in points]).reshape(-1, 6) for k in (0, 1))
    check_rates(model, speeds, np.zeros((1, 6)), what=f"{phase} velocities", where=where)
    return Trajectory(times, q)
