"""Check of a program that was read back: it is the plan's motion, and within the arm's limits."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose, tip_rates
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.export.program import (
    ANGLE_TOLERANCE_RAD,
    Program,
    check_positions,
    check_rates,
    check_trajectory,
    program_of,
    straight_move,
    stream_times,
    tip_poses,
    waypoint_rows,
)
from puncture_twin.planning.motion.follow import TIP_STEP_RAD
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_check import POSE_TOLERANCE_MM, SPEED_ROUNDING, STRAIGHT_TOLERANCE_MM

SAME_BRANCH_RAD = 0.01
"""How far the joints of the straight move may end from the plan's: a hundredth of the path to another branch."""

SAME_RATE = 1e-6
"""How far, as a fraction, a printed speed may be from the plan's: a speed of 1e-6 rad/s still has six digits."""

TURN_TOLERANCE_RAD = 1e-3
"""How far the straight move's orientation may be from the plan's: 0.2 mm over 200 mm of needle."""


def check_program(program: Program, plan: Plan, blends_mm: Floats | None = None, *, where: Path) -> None:
    """Refuse a program that is not the plan's motion, or that breaks a limit.

    Args:
        blends_mm: The radii that were found free, as for :func:`program_of`.

    Raises:
        InputError: Says what differs or which limit is broken.
    """
    model = plan.model
    for name, read, planned in (
        ("start", program.start_q, plan.approach.q[0]),
        ("standoff", program.standoff_q, plan.insertion.q[0]),
        ("target", program.target_q, plan.insertion.q[-1]),
    ):
        _check_same(read, planned, f"the {name}", where)
    wanted = program_of(plan, blends_mm)
    if not (
        len(program.moves) == len(wanted.moves)
        and np.allclose(_rates(program), _rates(wanted), rtol=SAME_RATE, atol=0.0)
    ):
        what = "a speed, an acceleration or a radius does not read back"
        refuse(what, where, "the plan's, above 1e-6", "not_read_back")
    _check_approach(program, plan, model, where)
    _check_insertion(program, plan, model, where)


def _rates(program: Program) -> Floats:
    """All numbers that a program prints except angles and poses; 1 + mm for radii, which may be 0."""
    moves = [(move.speed, move.acceleration, 1.0 + move.blend_mm) for move in program.moves]
    return np.array([program.tcp_mm, program.insertion_mm_s, program.insertion_mm_s2, *np.ravel(moves)])


def _check_approach(program: Program, plan: Plan, model: UrModel, where: Path) -> None:
    if len(program.stream_q):
        times = stream_times(len(program.stream_q))
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
        _check_tip(model, start, end, fraction * move.speed * np.sign(end - start), plan, where)
    if program.moves and program.moves[-1].blend_mm != 0.0:
        refuse("the approach does not stop at its end", where, "a blend radius of 0 at the end", "not_read_back")


def _check_tip(model: UrModel, start: Floats, end: Floats, speeds: Floats, plan: Plan, where: Path) -> None:
    """Refuse a joint move at whose peak joint speeds (6,) the tip would be too fast somewhere."""
    steps = math.ceil(float(np.linalg.norm(end - start)) / TIP_STEP_RAD)
    q = start + np.linspace(0.0, 1.0, steps + 1)[:, None] * (end - start)
    fastest = float(tip_rates(model, q, speeds, plan.needle_length_mm).max())
    if not fastest <= plan.speeds.tip_speed_mm_s * (1.0 + SPEED_ROUNDING):
        what = f"a joint move takes the tip to {fastest:.4g} mm/s"
        refuse(what, where, f"at most {plan.speeds.tip_speed_mm_s:g} mm/s", "tip_too_fast")


def _check_insertion(program: Program, plan: Plan, model: UrModel, where: Path) -> None:
    tips = tip_poses(plan)
    for name, read, planned in (
        ("standoff", program.T_base_standoff, tips[0]),
        ("target", program.T_base_target, tips[-1]),
    ):
        off, angle = _pose_difference(read, planned)
        if not (off <= POSE_TOLERANCE_MM and angle <= TURN_TOLERANCE_RAD):
            refuse(f"the {name} pose is {off:.3g} mm off", where, f"{POSE_TOLERANCE_MM} mm", "not_read_back")
    if not program.insertion_mm_s <= plan.speeds.insertion_speed_mm_s * (1.0 + SPEED_ROUNDING):
        what = f"the insertion at {program.insertion_mm_s:.4g} mm/s"
        refuse(what, where, f"at most {plan.speeds.insertion_speed_mm_s:g} mm/s", "tip_too_fast")
    angle = _pose_difference(program.T_base_standoff, program.T_base_target)[1]
    if not angle <= TURN_TOLERANCE_RAD:
        refuse(f"the needle rotates by {angle:.3g} rad on its path", where, "a straight path", "not_straight")
    moved = straight_move(model, program)
    ends = np.abs(moved.q[[0, -1]] - np.stack([program.standoff_q, program.target_q])).max()
    if not ends <= SAME_BRANCH_RAD:
        refuse(f"the straight move ends {ends:.3g} rad off", where, "the plan's own branch", "not_read_back")
    worst = _farthest_mm(flange_pose(model, moved.q)[:, :3, 3], flange_pose(model, plan.insertion.q)[:, :3, 3])
    if not worst <= STRAIGHT_TOLERANCE_MM:
        refuse(f"the straight move is {worst:.3g} mm off the planned path", where, "the plan", "not_straight")
    check_trajectory(model, moved, time_resolution_s=0.0, what="insertion", where=where)


def _farthest_mm(points: Floats, line: Floats) -> float:
    """The farthest that points (m, 3) lie from the straight line through the ends of another path (k, 3)."""
    unit = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    worst = 0.0
    for path in (points, line):
        away = path - line[0]
        worst = max(worst, float(np.linalg.norm(away - (away @ unit)[:, None] * unit, axis=1).max()))
    return worst


def _pose_difference(T_a: Floats, T_b: Floats) -> tuple[float, float]:
    angle = math.acos(float(np.clip((np.trace(T_a[:3, :3].T @ T_b[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
    return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])), angle


def _check_same(read: Floats, planned: Floats, what: str, where: Path) -> None:
    if read.shape != planned.shape or not np.abs(read - planned).max() <= ANGLE_TOLERANCE_RAD:
        refuse(f"{what} does not read back as in the plan", where, "the plan's angles", "not_read_back")
