"""Checks of a plan: motion, inputs of its case, contacts, labels; and the arm's numbers in its file."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.arm.insertion import needle_lines
from puncture_twin.planning.arm.kinematics import flange_pose, slowed, tip_speeds
from puncture_twin.planning.arm.ur import UR_MODELS, UrModel, ur_model
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.provenance import differing_input
from puncture_twin.planning.base.strict_json import array, number, text
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import needle_pose
from puncture_twin.planning.collision.workcell import home_configuration
from puncture_twin.planning.motion.follow import MAX_JERK
from puncture_twin.planning.motion.path_check import path_states
from puncture_twin.planning.motion.trajectory import Peaks
from puncture_twin.planning.plan.plan import Plan, motion_contact, phase_clearances
from puncture_twin.planning.reach.standoff import standoffs
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.chances import satisfies_limits
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import reason_text
from puncture_twin.planning.uncertainty.pose_error import expected_error_mm

POSE_TOLERANCE_MM = 0.01
"""How far the tip of the stored joint angles may be from the stored pose: well above rounding, far below any error."""
JOIN_TOLERANCE_RAD = 1e-9
"""How far the insertion may start from where the approach ends: rounding of the time laws."""
STRAIGHT_TOLERANCE_MM = 0.1
"""How far the tip may leave the straight path during the insertion: what a UR3 repeats."""
BETWEEN_RAD = 0.002
"""Joint step at which an insertion is looked at between its rows: up to 1.3 mm at the tip, bent by far less."""
MOST_STATES = 100_000
"""Joints that turn through more steps than this (200 rad) during one insertion do something else."""
ROLL_TOLERANCE_RAD = 1e-4
"""How far the stated roll may be from that of the joint angles: what the pose's tolerance lets the flange turn."""
ANGLE_ROUNDING = 1e-12
"""Fraction of a turn by which degrees and radians round."""
SPEED_ROUNDING = 1e-3
"""A time law that just keeps a speed may exceed it by its sampling."""
AGREE = "T_base_ct, target_ct_mm, outward_ct, needle_length_mm, standoff_mm and joint angles must agree"


def rate_limits(model: UrModel) -> Peaks:
    """The highest rates of an arm's joints in a plan, rad and s."""
    return Peaks(model.max_speeds, np.full(6, model.max_acceleration), np.full(6, MAX_JERK))


def with_case_arm(plan: Plan, case: Case) -> Plan:
    """A plan from a file with its case's arm: the file states the arm's numbers, but not its shapes."""
    return replace(plan, model=case.robot.model) if same_arm(plan.model, case.robot.model) else plan


def check_inputs(plan: Plan, case: Case, path: Path) -> None:
    """Refuse a plan whose case has changed since."""
    name = differing_input(plan.inputs, case.inputs)
    if name is not None:
        refuse(f"input '{name}' differs from the one used for the plan", path, "plan again", "input_changed")


def check_geometry(plan: Plan, path: Path) -> None:
    """Refuse a motion with a gap, off the straight line from standoff to target, too fast, or beyond joint limits."""
    if not np.allclose(plan.approach.q[-1], plan.insertion.q[0], rtol=0, atol=JOIN_TOLERANCE_RAD):
        refuse("the insertion does not start where the approach ends", path, "connected phases", "phases_not_joined")
    _check_straight(plan, path)
    _check_speeds(plan, path)
    for name, q, standoff in (
        ("standoff", plan.insertion.q[0], plan.standoff_mm),
        ("target", plan.insertion.q[-1], 0.0),
    ):
        pose = needle_pose(plan.target_ct, plan.outward_ct, standoff=standoff, length=plan.needle_length_mm)
        T_base_flange = flange_pose(plan.model, q)
        tip = T_base_flange[:3, 3] + plan.needle_length_mm * T_base_flange[:3, 2]
        for what, point, wanted in (("tip", tip, pose.tip_ct), ("flange", T_base_flange[:3, 3], pose.top_ct)):
            error = float(np.linalg.norm(point - plan.T_base_ct[:3, :3] @ wanted - plan.T_base_ct[:3, 3]))
            if not error <= POSE_TOLERANCE_MM:
                stated = f"the {what} at {name} is {error:.3g} mm off the stored pose"
                refuse(stated, path, f"at most {POSE_TOLERANCE_MM} mm: {AGREE}", "plan_contradicted")


def check_angles(plan: Plan, path: Path) -> None:
    """Refuse a roll that is not that of the joint angles at standoff, theta beyond 180 degrees, beta beyond 360."""
    for name, angle, turn in (("theta_deg", plan.theta, np.pi), ("beta_deg", plan.beta, 2 * np.pi)):
        if not 0.0 <= angle <= turn * (1 + ANGLE_ROUNDING):
            refuse(f"{name} = {np.degrees(angle):g}", path, f"0 to {np.degrees(turn):g}", "out_of_range")
    roll = roll_of(plan)
    difference = abs((plan.roll - roll + np.pi) % (2 * np.pi) - np.pi)
    if difference > ROLL_TOLERANCE_RAD or not 0.0 <= plan.roll < 2 * np.pi:
        what = f"roll_deg is {np.degrees(plan.roll):g}, but the joint angles at standoff give {np.degrees(roll):.4g}"
        refuse(what, path, "plan again", "plan_contradicted")


def roll_of(plan: Plan) -> float:
    """Rotation about the needle, rad, 0 to 2 pi, by the joints at standoff, whatever the plan states."""
    R, t = plan.T_base_ct[:3, :3], plan.T_base_ct[:3, 3]
    line = needle_lines((R @ plan.target_ct + t)[None], (R @ plan.outward_ct)[None])[0]
    x_axis = line.R_base_flange.T @ flange_pose(plan.model, plan.insertion.q[0])[:3, 0]
    return float(np.arctan2(x_axis[1], x_axis[0])) % (2 * np.pi)


def _check_straight(plan: Plan, path: Path) -> None:
    """Refuse an insertion that leaves the straight line, tilts the needle, goes too deep or turns back.

    Between two stored rows the joints turn evenly, so the motion is looked at there too.
    """
    q = plan.insertion.q
    counts = np.ceil(np.abs(np.diff(q, axis=0)).max(axis=1, initial=0.0) / BETWEEN_RAD).clip(min=1)
    if counts.sum() > MOST_STATES:
        refuse("the joints rotate repeatedly during the insertion", path, "a straight insertion", "not_straight")
    poses = flange_pose(plan.model, path_states(q, counts.astype(np.int64)))
    forward = poses[:, :3, 2]
    tips = poses[:, :3, 3] + plan.needle_length_mm * forward
    R, t = plan.T_base_ct[:3, :3], plan.T_base_ct[:3, 3]
    outward, from_target = R @ plan.outward_ct, tips - (R @ plan.target_ct + t)
    along = from_target @ outward
    aside = np.linalg.norm(from_target - along[:, None] * outward, axis=1).max()
    swing = plan.needle_length_mm * np.linalg.norm(forward + outward, axis=1).max()
    back = np.max(along - np.minimum.accumulate(along))
    deep = max(-along.min(), along.max() - plan.standoff_mm)
    for what, amount in (
        ("tip leaves the straight path", aside),
        ("flange end of the needle swings out", swing),
        ("insertion reverses", back),
        ("insertion goes beyond standoff and target", deep),
    ):
        if not amount <= STRAIGHT_TOLERANCE_MM:
            allowed = f"at most {STRAIGHT_TOLERANCE_MM} mm: {AGREE}"
            refuse(f"the {what} by {amount:.3g} mm", f"{path}: insertion", allowed, "not_straight")


def _check_speeds(plan: Plan, path: Path) -> None:
    model = plan.model
    for phase, part, limit in (
        ("approach", plan.approach, plan.speeds.tip_speed_mm_s),
        ("insertion", plan.insertion, plan.speeds.insertion_speed_mm_s),
    ):
        speed = float(tip_speeds(model, part.q, part.times_s, plan.needle_length_mm).max(initial=0.0))
        if not speed <= limit * (1 + SPEED_ROUNDING):
            what = f"the {phase} moves the tip at {speed:.3g} mm/s"
            refuse(what, path, f"at most {limit:g} mm/s; plan again", "tip_too_fast")
        if not model.within_limits(part.q).all():
            what = f"the {phase} leaves the joint limits"
            refuse(what, path, "angles within the arm's limits", "joint_beyond_limits")
        peaks, limits = part.peaks(), rate_limits(slowed(model, plan.speeds))
        for rate in ("speed", "acceleration"):  # a jerk wears the arm, and does not stop it
            most = float((getattr(peaks, rate) / getattr(limits, rate)).max())
            if not most <= 1 + SPEED_ROUNDING:
                what = f"the {phase} has {most:.3g} times the allowed {rate} of a joint"
                refuse(what, path, "the limits of the arm and of [robot]; plan again", "joint_too_fast")


ARM_NAMES = (
    *("shipped", "lengths_mm", "joint_limits_rad", "max_speeds_rad_s", "max_torques_nm"),
    *("max_acceleration_rad_s2", "joint_names"),
)
"""Keys of an arm that is stated by its numbers."""


def arm_document(model: UrModel) -> dict[str, Any] | None:
    """The numbers of an arm; None for one of the table, whose name gives them."""
    if UR_MODELS.get(model.name) == model:
        return None
    return {
        "shipped": model.shipped,
        "lengths_mm": model.lengths.tolist(),
        "joint_limits_rad": model.joint_limits.tolist(),
        "max_speeds_rad_s": model.max_speeds.tolist(),
        "max_torques_nm": model.max_torques.tolist(),
        "max_acceleration_rad_s2": model.max_acceleration,
        "joint_names": list(model.joint_names),
    }


def read_arm(name: str, document: Any) -> UrModel:
    """The arm of a plan, from its `arm_document`; one of the user's own has no shapes yet, which its case holds.

    Raises:
        InputError: No arm of that name.
        TypeError, KeyError, ValueError: Numbers that are no arm's.
    """
    if document is None:
        return ur_model(name)
    if set(document) != set(ARM_NAMES):
        raise ValueError(f"an arm is stated by {', '.join(ARM_NAMES)}")
    d1, a2, a3, d4, d5, d6 = array(document["lengths_mm"], (6,)).tolist()
    model = UrModel(
        *(name, d1, a2, a3, d4, d5, d6),
        joint_limits=array(document["joint_limits_rad"], (6, 2)),
        max_speeds=array(document["max_speeds_rad_s"], (6,)),
        max_torques=array(document["max_torques_nm"], (6,)),
        max_acceleration=number(document["max_acceleration_rad_s2"]),
        joint_names=tuple(text(one) for one in document["joint_names"]),
        shipped=document["shipped"] is True,
    )
    # numbers that no arm has, and an arm of the table that is not the table's but for narrower limits
    positive = np.array([1, -1, -1, 1, 1, 1]) * model.lengths
    low, high = model.joint_limits.T
    above_zero = [positive, high - low, model.max_speeds, model.max_torques, np.array([model.max_acceleration])]
    if not all(bool((values > 0.0).all()) for values in above_zero) or len(model.joint_names) != len(low):
        raise ValueError("lengths, limits, speeds and torques belong to no arm")
    if model.shipped:
        known = ur_model(model.name)
        narrower = replace(known, joint_limits=model.joint_limits, max_speeds=model.max_speeds)
        within = known.within_limits(model.joint_limits.T).all() and (model.max_speeds <= known.max_speeds).all()
        if narrower != model or not within:
            raise ValueError(f"the numbers are not those of a {model.name}")
    return model


def same_arm(one: UrModel, other: UrModel) -> bool:
    """Whether two arms have the same numbers; the shapes of an own arm are those of the case's inputs."""
    return replace(one, urdf=None) == replace(other, urdf=None)


SAME_DIRECTION = 1e-6
"""Largest difference of two unit vectors that name one direction: degrees in the file are rounded to 1e-15."""
SAME_NUMBER_MM = 1e-4
"""A number that is computed again may differ by this: FCL's own threshold."""


def check_plan(plan: Plan, context: CaseContext, path: Path, *, seed: int | None = None) -> Candidates:
    """Check a loaded plan's direction and motion anew, and that it states ``seed``, where one is given.

    Raises:
        InputError: The inputs changed, the direction is not safe any more, or the motion touches something.
    """
    check_inputs(plan, context.case, path)
    if not same_arm(plan.model, context.case.robot.model):
        refuse("its arm differs from the case's", path, "plan again", "plan_of_another")
    if context.reach is None or not np.array_equal(plan.T_base_ct, context.reach.T_base_ct):
        refuse("T_base_ct differs from the case's", path, "plan again", "plan_of_another")
    candidates = context.check(plan.theta, plan.beta)
    if not np.allclose(candidates.outward_ct[0], plan.outward_ct, atol=SAME_DIRECTION):
        refuse("outward_ct is not the direction of theta_deg, beta_deg", path, "plan again", "plan_contradicted")
    if not candidates.safe[0]:
        refuse(f"its direction is rejected now: {reason_text(candidates, 0)}", path, "plan again", "direction_rejected")
    _check_limits(plan, context, path)
    if seed is not None:
        _check_same("seed", plan.seed, seed, path)
    _check_labels(plan, context, candidates, path)
    if plan.warnings != context.anatomy.warnings:  # people decide by them
        apart = set(plan.warnings) ^ set(context.anatomy.warnings)
        shown = f", such as '{min(apart)}'" if apart else ""
        refuse(f"its warnings differ from the case's{shown}", path, "plan again", "plan_of_another")
    check_angles(plan, path)
    touched = motion_contact(plan, context.reach.checker)
    if touched is not None:
        refuse(f"its {touched}", path, "a motion without contact", "motion_touches")
    for phase, known in phase_clearances(plan, context.reach.checker).items():
        _check_same(f"clearance_mm.{phase}", plan.clearance_mm.get(phase, np.nan), known, path)
    return candidates


def _check_limits(plan: Plan, context: CaseContext, path: Path) -> None:
    """Refuse a plan that ends in a configuration beyond the case's limits of chances: the search's may be another."""
    if context.chance is None:
        return
    if not satisfies_limits(context.chance, plan.outward_ct[None], plan.insertion.q[-1:]).all():
        what = "its final configuration does not keep search.min_hit and max_touch"
        refuse(what, path, "plan again", "limits_not_kept")


def _check_labels(plan: Plan, context: CaseContext, candidates: Candidates, path: Path) -> None:
    """Refuse a plan whose own numbers differ from the case's: people read them."""
    case, placement = context.case, context.placement
    error = float("nan") if placement is None else placement.target_error_mm
    if context.chance is not None:
        error = expected_error_mm(context.chance.error, plan.insertion.q[-1])
    stated: tuple[tuple[str, Any, Any], ...] = (
        ("case", plan.case_name, case.name),
        ("robot", plan.model.name, case.robot.model.name),
        ("needle_length_mm", plan.needle_length_mm, case.needle.length_mm),
        ("target_ct_mm", plan.target_ct, case.target_ct),
        ("entry_ct_mm", plan.entry_ct, candidates.path.entry_ct[0]),
        (
            "standoff_mm",
            plan.standoff_mm,
            standoffs(case.needle, candidates.path.length[0], candidates.path.skin_angle[0]),
        ),
        ("expected_target_error_mm", plan.expected_target_error_mm, error),
        ("clearance_mm.needle", plan.clearance_mm.get("needle", np.nan), candidates.clearance.least[0]),
        ("speed_limits", plan.speeds, case.robot.speeds),
        ("the approach's first row", plan.approach.q[0], home_configuration(case)),
    )
    for name, stated_value, known in stated:
        _check_same(name, stated_value, known, path)


def _check_same(name: str, stated: Any, known: Any, path: Path) -> None:
    """Refuse a stated number that differs from the computed one; in a file, no number is null."""
    if isinstance(known, str | int):
        same = stated == known
    else:
        stated, known = (np.where(np.isfinite(value), value, np.nan) for value in (stated, known))
        same = np.allclose(stated, known, rtol=0, atol=SAME_NUMBER_MM, equal_nan=True)
    if not same:
        refuse(f"{name} is {stated}, but the case gives {known}", path, "plan again", "plan_of_another")
