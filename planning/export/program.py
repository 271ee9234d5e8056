"""The URScript program of a plan as numbers: approach, standoff and insertion; and the checks before it is written.

The approach runs along the plan's own path: its straight joint segments from rest to rest are what ``movej`` runs
between two waypoints, so `corner_rows` finds the waypoints again in the samples. A smooth approach has no rests, and is
streamed instead. The insertion is one ``movel``: the plan's tip runs straight at one orientation, and so does this
move, on the one branch that leads on from the standoff without a jump.
`check_trajectory` compares samples with the arm's limits, `check_program` a program that was read back with the plan.
"""

from __future__ import annotations

import math
import string
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.inverse_kinematics import inverse, wrap_to_pi
from puncture_twin.planning.arm.kinematics import flange_pose, tip_rates
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.motion.follow import TIP_STEP_RAD
from puncture_twin.planning.motion.trajectory import SAMPLE_S, Trajectory
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_check import POSE_TOLERANCE_MM, SPEED_ROUNDING, STRAIGHT_TOLERANCE_MM
from puncture_twin.planning.plan.plan_document import PLAN_VERSION

STREAM_S = SAMPLE_S
"""Period of a streamed approach: that of a CB3 controller, and four of an e-Series one."""
MOST_SAMPLES = 200_000
"""Samples of one phase: 27 minutes of a stream. The straight move is checked in no more steps, however slow it is."""


@dataclass(frozen=True, eq=False)
class Program:
    """A URScript program as numbers: mm, rad, s, the controller's base frame."""

    tcp_mm: float  # needle tip in the flange frame, along z
    start_q: Floats  # shape (6,), as are the other two of the arm's joints
    moves: tuple[JointMove, ...]  # the approach as moves from rest to rest, or empty
    stream_q: Floats  # shape (n, 6), the approach as angles every ``STREAM_S``, or n = 0
    T_base_standoff: Floats  # shape (4, 4), needle tip before the insertion; ``standoff_q`` (6,) the arm there
    T_base_target: Floats  # shape (4, 4), needle tip after it; ``target_q`` (6,) the arm there
    standoff_q: Floats  # shape (6,), the arm before the insertion
    target_q: Floats  # shape (6,), the arm after it
    insertion_mm_s: float
    insertion_mm_s2: float


class JointMove(NamedTuple):
    """One ``movej``: a move that is straight in joint angles."""

    q: Floats  # where it ends, shape (6,), rad
    speed: float  # peak speed of the joint that turns farthest, rad/s
    acceleration: float  # peak acceleration of the same joint, rad/s^2
    blend_mm: float  # radius about its end within which the tip may round the corner; 0 stops there


def program_of(plan: Plan, blends_mm: Floats | None = None) -> Program:
    """The program of a plan; ``blends_mm`` (k - 2,) of each waypoint between the ends of `waypoint_rows`, None for 0.

    Raises InputError: the insertion does not move the tip, or a smooth approach takes too long to stream.
    """
    rows = waypoint_rows(plan)
    between = np.zeros(max(0, len(rows) - 2)) if blends_mm is None else np.asarray(blends_mm, dtype=np.float64)
    moves = []
    for (first, last), blend in zip(pairwise(rows.tolist()), [*between.tolist(), 0.0], strict=False):
        q, times = plan.approach.q[first : last + 1], plan.approach.times_s[first : last + 1]
        leading = int(np.argmax(np.abs(q[-1] - q[0])))  # movej's speed is that of the joint that moves farthest
        moves.append(JointMove(q[-1], *_ramp(np.abs(q[:, leading] - q[0, leading]), times), blend))
    steps = math.ceil(plan.approach.duration_s / STREAM_S) if len(rows) == 0 else 0
    if steps > MOST_SAMPLES:
        what = f"a smooth approach of {plan.approach.duration_s:.0f} s"
        refuse(what, "plan", f"at most {MOST_SAMPLES * STREAM_S:.0f} s", "too_long")
    tips = tip_poses(plan)
    points = tips[:, :3, 3]
    length = float(np.linalg.norm(points[-1] - points[0]))
    if length <= POSE_TOLERANCE_MM or len(points) < 2:
        refuse("the insertion does not move the tip", "plan", "an insertion", "no_motion")
    speed, acceleration = _ramp((points - points[0]) @ (points[-1] - points[0]) / length, plan.insertion.times_s)
    return Program(
        tcp_mm=plan.needle_length_mm,
        start_q=plan.approach.q[0],
        moves=tuple(moves),
        stream_q=plan.approach.at(STREAM_S * np.arange(1, steps + 1, dtype=np.float64)).reshape(-1, 6),
        T_base_standoff=tips[0],
        T_base_target=tips[-1],
        standoff_q=plan.insertion.q[0],
        target_q=plan.insertion.q[-1],
        insertion_mm_s=speed,
        insertion_mm_s2=acceleration,
    )


def waypoint_rows(plan: Plan) -> NDArray[np.intp]:
    """Rows of the approach's waypoints, both ends among them: one where nothing moves, none for a smooth approach."""
    if np.abs(plan.approach.q - plan.approach.q[0]).max() <= STRAIGHT_RAD:
        return np.zeros(1, dtype=np.intp)
    rows = corner_rows(plan.approach.q)
    return rows if rests_at(plan.model, plan.approach, rows[1:-1]) else rows[:0]


def straight_move(model: UrModel, program: Program) -> Trajectory:
    """The insertion as the controller runs it: the tip straight, a trapezoid in time, on the standoff's branch.

    Raises InputError: no branch leads from the standoff to the target.
    """
    start, end = program.T_base_standoff[:3, 3], program.T_base_target[:3, 3]
    length = float(np.linalg.norm(end - start))
    times, travelled = _trapezoid(length, program.insertion_mm_s, program.insertion_mm_s2)
    poses = np.repeat(program.T_base_target[None], len(times), axis=0)
    poses[:, :3, 3] = start + travelled[:, None] * (end - start) / length - program.tcp_mm * poses[:, :3, 2]
    branches = inverse(model, poses)
    off = np.abs(wrap_to_pi(branches[0] - program.standoff_q)).max(axis=1)  # by the joint farthest off
    if np.isnan(off).all():
        refuse("the arm does not reach the standoff", "insertion", "a pose within reach", "out_of_reach")
    q = branches[:, int(np.nanargmin(off))]
    if np.isnan(q).any():
        refuse("the arm does not reach the whole straight path", "insertion", "one branch", "out_of_reach")
    first = program.standoff_q + wrap_to_pi(q[0] - program.standoff_q)
    return Trajectory(times, np.concatenate([first[None], first + np.cumsum(wrap_to_pi(np.diff(q, axis=0)), axis=0)]))


def _ramp(travelled: Floats, times: Floats) -> tuple[float, float]:
    """Peak speed v and acceleration a of the trapezoid with a motion's length L, duration T and highest acceleration.

    From T = L / v + v / a follows v = a (T - sqrt(T^2 - 4 L / a)) / 2: below the motion's own peak speed, since a plan
    takes time to build up its acceleration and a trapezoid does not. Where a is too low for T, which samples too far
    apart can make it seem, v = a T / 2 takes longer.
    """
    steps = np.diff(times)
    speeds = np.concatenate([[0.0], np.diff(travelled) / steps, [0.0]])
    between = (np.concatenate([[0.0], steps]) + np.concatenate([steps, [0.0]])) / 2.0
    acceleration = float(np.abs(np.diff(speeds) / between).max())
    duration = float(times[-1] - times[0])
    spare = max(0.0, duration**2 - 4.0 * float(travelled[-1]) / acceleration)
    return acceleration * (duration - math.sqrt(spare)) / 2.0, acceleration


def tip_poses(plan: Plan) -> Floats:
    """T_base_tip of every sample of the insertion, shape (m, 4, 4), mm."""
    poses = flange_pose(plan.model, plan.insertion.q)
    poses[:, :3, 3] += plan.needle_length_mm * poses[:, :3, 2]
    return poses


def _trapezoid(length: float, speed: float, acceleration: float) -> tuple[Floats, Floats]:
    """Times and distances run, both (m,), from rest to rest, in equal steps of ``STREAM_S`` or, of a long one, more."""
    speed = min(speed, math.sqrt(length * acceleration))  # a triangle where the length is short
    ramp, plateau = speed / acceleration, length / speed - speed / acceleration
    end = 2.0 * ramp + plateau
    times = np.linspace(0.0, end, min(max(2, math.ceil(end / STREAM_S)), MOST_SAMPLES) + 1)
    early, late = np.minimum(times, ramp), np.maximum(times - ramp - plateau, 0.0)
    travelled = acceleration * early**2 / 2 + speed * (times - early) - acceleration * late**2 / 2
    travelled[-1] = length  # sums of steps round
    return times, travelled


ANGLE_TOLERANCE_RAD = 1e-9
"""How far an angle that was read back may be from the plan's."""
TIME_TOLERANCE_S = 1e-9
"""How far a time that was read back may be from the plan's: ROS counts nanoseconds, which is half of one at most."""


class SampledMotion(NamedTuple):
    """Both phases as samples, each from time 0."""

    approach: Trajectory
    insertion: Trajectory


def check_sampled(motion: SampledMotion, plan: Plan, *, time_resolution_s: float, where: Path) -> None:
    """Refuse samples that are not the plan's, or that break a limit."""
    for name in SampledMotion._fields:
        read, planned = getattr(motion, name), getattr(plan, name)
        same_angles = read.q.shape == planned.q.shape and np.abs(read.q - planned.q).max() <= ANGLE_TOLERANCE_RAD
        if not (same_angles and np.abs(read.times_s - planned.times_s).max() <= TIME_TOLERANCE_S):
            refuse(f"the {name} does not read back as in the plan", where, "the plan's samples", "not_read_back")
        check_trajectory(plan.model, read, time_resolution_s=time_resolution_s, what=name, where=where)


POSITION_SLACK_RAD = 1e-9
"""A printed angle may round beyond its limit by this."""
RELATIVE_SLACK = 1e-6
"""Rounding of printed speeds and of differences, as a fraction of the limit."""
ROUNDINGS = 8.0
"""Differences of differences of angles carry at most this many roundings of one angle."""


def check_positions(model: UrModel, q: Floats, *, what: str, where: Path) -> None:
    """Refuse angles (m, 6), rad, outside the joints' limits; NaN is outside."""
    inside = (q >= model.joint_limits[:, 0] - POSITION_SLACK_RAD) & (q <= model.joint_limits[:, 1] + POSITION_SLACK_RAD)
    if not inside.all():
        row, joint = np.argwhere(~inside)[0]
        low, high = np.degrees(model.joint_limits[joint])
        at = f"{what}: {model.joint_names[joint]} at {np.degrees(q[row, joint]):.3f} deg"
        refuse(at, where, f"{low:.0f} to {high:.0f} deg", "joint_beyond_limits")


def check_rates(model: UrModel, speeds: Floats, accelerations: Floats, *, what: str, where: Path) -> None:
    """Refuse speeds (m, 6), rad/s, and accelerations (k, 6), rad/s^2, above the limits; NaN is above."""
    most = np.full(6, model.max_acceleration)
    for rates, limits, unit in ((speeds, model.max_speeds, "rad/s"), (accelerations, most, "rad/s^2")):
        within = np.abs(rates) <= limits * (1.0 + RELATIVE_SLACK)
        if not within.all():
            row, joint = np.argwhere(~within)[0]
            at = f"{what}: {model.joint_names[joint]} at {abs(rates[row, joint]):.6g} {unit}"
            refuse(at, where, f"at most {limits[joint]:.6g} {unit}", "joint_too_fast")


def check_trajectory(
    model: UrModel, trajectory: Trajectory, *, time_resolution_s: float, what: str, where: Path
) -> None:
    """Refuse samples outside any limit, by differences, from rest to rest.

    The mean speeds of neighbouring intervals differ by no more than the acceleration times the distance of their
    middles, so a motion within the limits is never refused, but for rounding, which is taken off here.
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
    accelerations = np.maximum(np.abs(change) - blur_between, 0.0) / between
    check_rates(model, np.maximum(np.abs(speeds) - blur, 0.0), accelerations, what=what, where=where)


STRAIGHT_RAD = 1e-9
"""Joint distance within which samples lie on a straight segment: far above rounding, a millionth of a degree."""
REST_SLACK = 1e-6
"""Relative rounding of a speed by differences."""


def corner_rows(q: Floats) -> NDArray[np.intp]:
    """Rows of the corners and reversals of a path, with both ends; every other row lies between two of them.

    Splits at the row farthest from the chord until none is off (Douglas and Peucker 1973, in six dimensions). For a
    path of straight segments that row is always one of its waypoints. Shape (k,), rising, of q (m, 6), rad.
    """
    corners, pending = {0, len(q) - 1}, [(0, len(q) - 1)]
    while pending:
        first, last = pending.pop()
        split = _turning_row(q[first : last + 1])
        if split is not None:
            corners.add(first + split)
            pending += [(first, first + split), (first + split, last)]
    return np.array(sorted(corners), dtype=np.intp)


def _turning_row(rows: Floats) -> int | None:
    """The row farthest from the segment between the ends, or the last before the path reverses; None if straight."""
    if len(rows) < 3:
        return None
    away, chord = rows - rows[0], rows[-1] - rows[0]
    length = float(np.linalg.norm(chord))
    unit = chord / length if length > STRAIGHT_RAD else np.zeros(6)
    along = np.clip(away @ unit, 0.0, length)
    off = np.linalg.norm(away - along[:, None] * unit, axis=1)
    if off[1:-1].max() > STRAIGHT_RAD:
        return int(np.argmax(off[1:-1])) + 1
    back = np.flatnonzero(np.diff(along) < -STRAIGHT_RAD)
    return int(back[0]) if len(back) else None


def rests_at(model: UrModel, trajectory: Trajectory, rows: NDArray[np.intp]) -> bool:
    """Whether the arm can be at rest at each row: next to it no joint is faster than one step of braking allows."""
    steps = np.diff(trajectory.times_s)[:, None]
    most = model.max_acceleration * steps**2 * (1.0 + REST_SLACK)
    slow = np.all(np.abs(np.diff(trajectory.q, axis=0)) <= most, axis=1)
    return bool((slow[rows - 1] & slow[rows]).all())


PLAIN = frozenset(string.ascii_letters + string.digits + " ._-+:/()")
"""Characters of a comment or a string in any of the formats: none that ends, escapes or nests one."""
LONGEST = 200
"""Most characters of a name; a longer one is cut."""


def plain_text(text: str) -> str:
    """A name with every character outside ``PLAIN`` turned into an underscore, cut at ``LONGEST``.

    >>> plain_text('liver"); halt #')
    'liver_)_ halt _'
    """
    return "".join(character if character in PLAIN else "_" for character in text[:LONGEST])


SENTENCE_WIDTH = 110
"""Columns of a warning's lines in a comment."""


def warning_lines(warnings: Sequence[str]) -> list[str]:
    """The warnings of a plan for a comment: how many, then each whole, on as many lines as it needs.

    >>> warning_lines(("the 'skin' is open; a box",))
    ['1 warning when this was planned:', 'warning: the skin is open, a box']
    """
    if not warnings:
        return ["warnings when this was planned: none"]
    lines = [line for one in warnings for line in textwrap.wrap(f"warning: {plain_sentence(one)}", SENTENCE_WIDTH)]
    return [f"{plural(len(warnings), 'warning')} when this was planned:", *lines]


def plain_sentence(text: str) -> str:
    """A sentence whole, in the characters of ``PLAIN`` and commas: no quotes, and a comma for a semicolon."""
    text = text.translate({ord("'"): None, ord('"'): None, ord(";"): ",", ord("%"): "percent"})
    return "".join(character if character in PLAIN or character == "," else "_" for character in text)


def heading(plan: Plan, notes: Iterable[str], *, case_checked: bool) -> list[str]:
    """Comment lines that say what a file is, what it was made from, and how to read it."""
    lines = [
        "research software, not a medical device",
        f"made by puncture-twin {version('puncture-twin')} from a plan of version {PLAN_VERSION}, seed {plan.seed}",
        f"case: {plain_text(plan.case_name)}",
        *(f"input: {plain_text(f'{one.role}: {one.path}')} sha256 {plain_text(one.sha256)}" for one in plan.inputs),
        f"robot: {plain_text(plan.model.name)}",
        f"direction: theta {np.degrees(plan.theta):g} deg, beta {np.degrees(plan.beta):g} deg",
        "this plan was " + ("checked against its case again" if case_checked else "NOT checked against its case again"),
        *warning_lines(plan.warnings),
        *notes,
    ]
    return [f"# {line}" for line in lines]


SAME_BRANCH_RAD = 0.01
"""How far the joints of the straight move may end from the plan's: a hundredth of the path to another branch."""
SAME_RATE = 1e-6
"""How far, as a fraction, a printed speed may be from the plan's: a speed of 1e-6 rad/s still has six digits."""
TURN_TOLERANCE_RAD = 1e-3
"""How far the straight move's orientation may be from the plan's: 0.2 mm over 200 mm of needle."""


def check_program(program: Program, plan: Plan, blends_mm: Floats | None = None, *, where: Path) -> None:
    """Refuse a program that is not the plan's motion, or that breaks a limit."""
    _check_same(program.start_q, plan.approach.q[0], "the start", where)
    _check_same(program.standoff_q, plan.insertion.q[0], "the standoff", where)
    _check_same(program.target_q, plan.insertion.q[-1], "the target", where)
    rates, wanted_rates = _rates(program), _rates(program_of(plan, blends_mm))
    if len(rates) != len(wanted_rates) or not np.allclose(rates, wanted_rates, rtol=SAME_RATE, atol=0.0):
        what = "a speed, an acceleration or a radius does not read back"
        refuse(what, where, "the plan's, above 1e-6", "not_read_back")
    _check_approach(program, plan, where)
    _check_insertion(program, plan, where)


def _rates(program: Program) -> Floats:
    """All numbers that a program prints except angles and poses; 1 + mm for radii, which may be 0."""
    moves = [(move.speed, move.acceleration, 1.0 + move.blend_mm) for move in program.moves]
    return np.array([program.tcp_mm, program.insertion_mm_s, program.insertion_mm_s2, *np.ravel(moves)])


def _check_approach(program: Program, plan: Plan, where: Path) -> None:
    model = plan.model
    if len(program.stream_q):
        times = STREAM_S * np.arange(len(program.stream_q) + 1, dtype=np.float64)
        streamed = Trajectory(times, np.concatenate([program.start_q[None], program.stream_q]))
        _check_same(streamed.q, plan.approach.at(times), "the streamed approach", where)
        check_trajectory(model, streamed, time_resolution_s=0.0, what="approach", where=where)
        return
    path = np.stack([program.start_q, *(move.q for move in program.moves)])
    check_positions(model, path, what="approach", where=where)
    _check_same(path, plan.approach.q[waypoint_rows(plan)], "the approach", where)
    for (start, end), move in zip(pairwise(path), program.moves, strict=True):
        fraction = np.abs(end - start) / np.abs(end - start).max()
        rates = fraction[None] * move.speed, fraction[None] * move.acceleration
        check_rates(model, *rates, what="approach", where=where)
        steps, speeds = math.ceil(float(np.linalg.norm(end - start)) / TIP_STEP_RAD), fraction * move.speed
        q = start + np.linspace(0.0, 1.0, steps + 1)[:, None] * (end - start)
        fastest = float(tip_rates(model, q, speeds * np.sign(end - start), plan.needle_length_mm).max())
        if not fastest <= plan.speeds.tip_speed_mm_s * (1.0 + SPEED_ROUNDING):
            what = f"a joint move takes the tip to {fastest:.4g} mm/s"
            refuse(what, where, f"at most {plan.speeds.tip_speed_mm_s:g} mm/s", "tip_too_fast")
    if program.moves and program.moves[-1].blend_mm != 0.0:
        refuse("the approach does not stop at its end", where, "a blend radius of 0 at the end", "not_read_back")


def _check_insertion(program: Program, plan: Plan, where: Path) -> None:
    model, tips = plan.model, tip_poses(plan)
    ends = (("standoff", program.T_base_standoff, tips[0]), ("target", program.T_base_target, tips[-1]))
    for name, read, planned in ends:
        off, angle = _pose_difference(read, planned)
        if not (off <= POSE_TOLERANCE_MM and angle <= TURN_TOLERANCE_RAD):
            refuse(f"the {name} pose is {off:.3g} mm off", where, f"{POSE_TOLERANCE_MM} mm", "not_read_back")
    if not program.insertion_mm_s <= plan.speeds.insertion_speed_mm_s * (1.0 + SPEED_ROUNDING):
        what = f"the insertion at {program.insertion_mm_s:.4g} mm/s"
        refuse(what, where, f"at most {plan.speeds.insertion_speed_mm_s:g} mm/s", "tip_too_fast")
    angle = _pose_difference(program.T_base_standoff, program.T_base_target)[1]
    if not angle <= TURN_TOLERANCE_RAD:
        refuse(f"the needle rotates by {angle:.3g} rad on its path", where, "a straight path", "not_straight")
    straight = straight_move(model, program)
    apart = np.abs(straight.q[[0, -1]] - np.stack([program.standoff_q, program.target_q])).max()
    if not apart <= SAME_BRANCH_RAD:
        refuse(f"the straight move ends {apart:.3g} rad off", where, "the plan's own branch", "not_read_back")
    line = flange_pose(model, plan.insertion.q)[:, :3, 3]
    unit = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    away = np.concatenate([flange_pose(model, straight.q)[:, :3, 3], line]) - line[0]  # both, from one straight line
    worst = float(np.linalg.norm(away - (away @ unit)[:, None] * unit, axis=1).max())
    if not worst <= STRAIGHT_TOLERANCE_MM:
        refuse(f"the straight move is {worst:.3g} mm off the planned path", where, "the plan", "not_straight")
    check_trajectory(model, straight, time_resolution_s=0.0, what="insertion", where=where)


def _pose_difference(T_a: Floats, T_b: Floats) -> tuple[float, float]:
    angle = math.acos(float(np.clip((np.trace(T_a[:3, :3].T @ T_b[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
    return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])), angle


def _check_same(read: Floats, planned: Floats, what: str, where: Path) -> None:
    if read.shape != planned.shape or not np.abs(read - planned).max() <= ANGLE_TOLERANCE_RAD:
        refuse(f"{what} does not read back as in the plan", where, "the plan's angles", "not_read_back")
