"""What a URScript program does, as numbers: the approach, the standoff, the insertion.

The approach is the plan's own way: its straight joint segments from rest to rest are what ``movej`` runs between two
waypoints, so the waypoints are found again in the samples. A smooth approach has no rests, and is streamed instead.
The insertion is one ``movel``: the plan's tip runs straight at one orientation, and so does this move, on the one
branch that leads on from the standoff without a jump.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.inverse_kinematics import inverse, wrap_to_pi
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.export.corners import STRAIGHT_RAD, corner_rows, rests_at
from puncture_twin.planning.motion.trajectory import SAMPLE_S, Trajectory
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_check import POSE_TOLERANCE_MM

STREAM_S = SAMPLE_S
"""Period of a streamed approach: that of a CB3 controller, and four of an e-Series one."""

MOST_SAMPLES = 200_000
"""Of one phase: 27 minutes of a stream. The straight move is looked at in no more steps, however slow it is."""


class JointMove(NamedTuple):
    """One ``movej``: straight in joint angles."""

    q: Floats
    """Where it ends, shape (6,), rad."""
    speed: float
    """Peak speed of the joint that turns farthest, rad/s."""
    acceleration: float
    """Of the same joint, rad/s^2."""
    blend_mm: float
    """Radius about its end within which the tip may round the corner; 0 stops there."""


@dataclass(frozen=True, eq=False)
class Program:
    """A URScript program's numbers: mm, rad, s, the controller's base frame.

    Attributes:
        tcp_mm: Needle tip in the flange frame, along z.
        start_q: Shape (6,), where the arm must stand.
        moves: The approach as moves from rest to rest, or empty.
        stream_q: Shape (n, 6), the approach as angles every ``STREAM_S``, or n = 0.
        T_base_standoff: Shape (4, 4), needle tip before the insertion.
        T_base_target: Shape (4, 4), needle tip after it.
        standoff_q: Shape (6,), the arm before the insertion.
        target_q: Shape (6,), the arm after it.
        insertion_mm_s: Tip speed of the insertion.
        insertion_mm_s2: Tip acceleration of the insertion.
    """

    tcp_mm: float
    start_q: Floats
    moves: tuple[JointMove, ...]
    stream_q: Floats
    T_base_standoff: Floats
    T_base_target: Floats
    standoff_q: Floats
    target_q: Floats
    insertion_mm_s: float
    insertion_mm_s2: float


class _Ramp(NamedTuple):
    """Peak speed and acceleration of a trapezoid."""

    speed: float
    acceleration: float


def waypoint_rows(plan: Plan) -> NDArray[np.intp]:
    """Rows of the approach's waypoints, both ends among them: one where nothing moves, none for a smooth approach."""
    if np.abs(plan.approach.q - plan.approach.q[0]).max() <= STRAIGHT_RAD:
        return np.zeros(1, dtype=np.intp)
    rows = corner_rows(plan.approach.q)
    straight = rests_at(plan.model, plan.approach, rows[1:-1])
    return rows if straight else rows[:0]


def program_of(plan: Plan, blends_mm: Floats | None = None) -> Program:
    """The program of a plan.

    Args:
        plan: The plan.
        blends_mm: Shape (k - 2,), a radius for each waypoint between the ends of :func:`waypoint_rows`; None for 0.

    Raises:
        InputError: The insertion does not move the tip, or a smooth approach takes too long to stream.
    """
    rows = waypoint_rows(plan)
    between = np.zeros(max(0, len(rows) - 2)) if blends_mm is None else np.asarray(blends_mm, dtype=np.float64)
    moves = tuple(
        _joint_move(plan.approach, first, last, blend)
        for (first, last), blend in zip(pairwise(rows.tolist()), [*between.tolist(), 0.0], strict=False)
    )
    steps = math.ceil(plan.approach.duration_s / STREAM_S) if len(rows) == 0 else 0
    if steps > MOST_SAMPLES:
        allowed = f"at most {MOST_SAMPLES * STREAM_S:.0f} s"
        raise InputError(f"a smooth approach of {plan.approach.duration_s:.0f} s", where="plan", allowed=allowed)
    tips = tip_poses(plan)
    insertion = _insertion_ramp(plan, tips)
    return Program(
        tcp_mm=plan.needle_length_mm,
        start_q=plan.approach.q[0],
        moves=moves,
        stream_q=plan.approach.at(stream_times(steps)[1:]).reshape(-1, 6),
        T_base_standoff=tips[0],
        T_base_target=tips[-1],
        standoff_q=plan.insertion.q[0],
        target_q=plan.insertion.q[-1],
        insertion_mm_s=insertion.speed,
        insertion_mm_s2=insertion.acceleration,
    )


def straight_move(model: UrModel, program: Program) -> Trajectory:
    """The insertion as the controller runs it: the tip straight, a trapezoid in time, on the standoff's branch.

    Args:
        model: The arm.
        program: Its poses, speed and acceleration.

    Raises:
        InputError: No branch leads from the standoff to the target.
    """
    start, end = program.T_base_standoff[:3, 3], program.T_base_target[:3, 3]
    length = float(np.linalg.norm(end - start))
    times, travelled = _trapezoid(length, program.insertion_mm_s, program.insertion_mm_s2)
    poses = np.repeat(program.T_base_target[None], len(times), axis=0)
    poses[:, :3, 3] = start + travelled[:, None] * (end - start) / length - program.tcp_mm * poses[:, :3, 2]
    branches = inverse(model, poses)
    off = np.abs(wrap_to_pi(branches[0] - program.standoff_q)).max(axis=1)
    if np.isnan(off).all():
        raise InputError("the arm does not reach its standoff", where="insertion", allowed="a pose within reach")
    q = branches[:, int(np.nanargmin(off))]
    if np.isnan(q).any():
        raise InputError("the arm does not reach all of the straight way", where="insertion", allowed="one branch")
    first = program.standoff_q + wrap_to_pi(q[0] - program.standoff_q)
    return Trajectory(times, np.concatenate([first[None], first + np.cumsum(wrap_to_pi(np.diff(q, axis=0)), axis=0)]))


def _joint_move(trajectory: Trajectory, first: int, last: int, blend_mm: float) -> JointMove:
    """The move over the samples first..last, in the time that the plan takes."""
    q, times = trajectory.q[first : last + 1], trajectory.times_s[first : last + 1]
    leading = int(np.argmax(np.abs(q[-1] - q[0])))
    ramp = _ramp(np.abs(q[:, leading] - q[0, leading]), times)
    return JointMove(q[-1], ramp.speed, ramp.acceleration, blend_mm)


def _ramp(travelled: Floats, times: Floats) -> _Ramp:
    """The trapezoid from rest to rest with a motion's length L, duration T and highest acceleration a.

    From T = L / v + v / a follows v = a (T - sqrt(T^2 - 4 L / a)) / 2: below the motion's own peak speed, since a plan
    takes time to build up its acceleration and a trapezoid does not. Where a is too low for T, which samples too far
    apart can make it seem, v = a T / 2 takes longer.

    Args:
        travelled: Shape (m,), rad or mm.
        times: Shape (m,), s.
    """
    steps = np.diff(times)
    speeds = np.concatenate([[0.0], np.diff(travelled) / steps, [0.0]])
    between = (np.concatenate([[0.0], steps]) + np.concatenate([steps, [0.0]])) / 2.0
    acceleration = float(np.abs(np.diff(speeds) / between).max())
    duration = float(times[-1] - times[0])
    spare = max(0.0, duration**2 - 4.0 * float(travelled[-1]) / acceleration)
    return _Ramp(acceleration * (duration - math.sqrt(spare)) / 2.0, acceleration)


def stream_times(steps: int) -> Floats:
    """Shape (steps + 1,), from 0, s."""
    return np.asarray(STREAM_S * np.arange(steps + 1), dtype=np.float64)


def tip_poses(plan: Plan) -> Floats:
    """T_base_tip of every sample of the insertion, shape (m, 4, 4), mm."""
    poses = flange_pose(plan.model, plan.insertion.q)
    poses[:, :3, 3] += plan.needle_length_mm * poses[:, :3, 2]
    return poses


def _insertion_ramp(plan: Plan, tips: Floats) -> _Ramp:
    points, times = tips[:, :3, 3], plan.insertion.times_s
    length = float(np.linalg.norm(points[-1] - points[0]))
    if length <= POSE_TOLERANCE_MM or len(points) < 2:
        raise InputError("the insertion does not move the tip", where="plan", allowed="an insertion")
    return _ramp((points - points[0]) @ (points[-1] - points[0]) / length, times)


def _trapezoid(length: float, speed: float, acceleration: float) -> tuple[Floats, Floats]:
    """Times and distances run, both (m,), from rest to rest, in equal steps of ``STREAM_S`` or, of a long one, more."""
    speed = min(speed, math.sqrt(length * acceleration))
    ramp, plateau = speed / acceleration, length / speed - speed / acceleration
    end = 2.0 * ramp + plateau
    times = np.linspace(0.0, end, min(max(2, math.ceil(end / STREAM_S)), MOST_SAMPLES) + 1)
    early, late = np.minimum(times, ramp), np.maximum(times - ramp - plateau, 0.0)
    travelled = acceleration * early**2 / 2 + speed * (times - early) - acceleration * late**2 / 2
    travelled[-1] = length
    return times, travelled
