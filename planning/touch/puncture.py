"""The puncture after touches: to where their registration puts the target, in the posture they were chosen for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from puncture_twin.planning.anatomy.skin_entry import skin_paths
from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.speed_limits import slowed
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.case.entry import angles
from puncture_twin.planning.collision.workcell import case_checker, home_configuration
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.motion.approach import plan_approach
from puncture_twin.planning.motion.follow import follow_smoothly
from puncture_twin.planning.plan.motion import motion_contact
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_check import roll_of
from puncture_twin.planning.reach.standoff import standoffs
from puncture_twin.planning.registration.registration import Registration
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.touch.straight_approach import line_to


def registered_joints(
    model: UrModel, tip_mm: float, q_insertion: Floats, target_ct: Floats, T_base_ct: tuple[Floats, Floats]
) -> Floats:
    """The joints that put the needle as planned in the CT, patient and all where a new registration puts them.

    Args:
        model: The arm.
        tip_mm: Flange to tip.
        q_insertion: Shape (6,), rad, the tip on the target as it was planned.
        target_ct: Shape (3,), mm.
        T_base_ct: The belief of that plan and the new one, shape (4, 4) each, mm.

    Returns:
        Shape (6,), rad, in the branch nearest to the plan's.

    Raises:
        NoAnswerError: The arm does not reach there.
    """
    believed, registered = T_base_ct
    T = flange_pose(model, q_insertion)
    T[:3, :3] = registered[:3, :3] @ believed[:3, :3].T @ T[:3, :3]
    T[:3, 3] = apply(registered, target_ct) - tip_mm * T[:3, 2]
    every = nearest_within_limits(model, inverse(model, T)[0], q_insertion)
    away = np.abs(every - q_insertion).max(axis=1)
    if np.isnan(away).all():
        raise NoAnswerError("the arm does not reach the target where the touches put it")
    return np.asarray(every[int(np.nanargmin(away))])


def plan_puncture(context: CaseContext, outward_ct: Floats, q_insertion: Floats, registration: Registration) -> Plan:
    """Plan the puncture along a direction by a new registration, free of contact where that puts the patient.

    Args:
        context: The case; what it believes of patient and arm is what the touches were planned by.
        outward_ct: Shape (3,), unit, from the target along the needle.
        q_insertion: Shape (6,), rad, the tip on the target as the touches were planned for.
        registration: Of the touches.

    Raises:
        NoAnswerError: The arm does not reach there, or not without contact.
    """
    case, T = context.case, registration.T_base_ct
    assert context.placement is not None
    checker, speeds = case_checker(case, context.anatomy, T), case.robot.speeds
    model, tip_mm, believed = checker.model, case.needle.length_mm, context.placement.T_base_ct
    q = registered_joints(model, tip_mm, q_insertion, case.target_ct, (believed, T))
    paths = skin_paths(context.anatomy.skin, case.target_ct, outward_ct[None], tip_mm)
    standoff = float(standoffs(case.needle, paths.path_length[0], paths.skin_angle[0]))
    line = line_to(model, tip_mm, q, standoff, 0.0)
    if line is None:
        raise NoAnswerError("the arm cannot follow the needle's line to the target where the touches put it")
    approach = plan_approach(
        checker, home_configuration(case), line[0], seed=case.rehearsal.seed, speeds=speeds
    ).trajectory
    theta, beta = angles(case.T_ct_entry[:3, :3].T @ outward_ct)
    depths = np.linspace(0.0, standoff, len(line))
    plan = Plan(
        case_name=case.name,
        inputs=case.inputs,
        seed=case.rehearsal.seed,
        model=case.robot.model,
        T_base_ct=T,
        expected_target_error_mm=float(registration.expected_tre_mm(case.target_ct[None])[0]),
        theta=float(theta),
        beta=float(beta),
        entry_ct=paths.entry_ct[0],
        target_ct=case.target_ct,
        outward_ct=outward_ct,
        roll=0.0,
        standoff_mm=standoff,
        needle_length_mm=tip_mm,
        approach=approach,
        insertion=follow_smoothly(slowed(model, speeds), line, depths, max_tip_speed_mm_s=speeds.insertion_speed_mm_s),
        clearance_mm={},
        speeds=speeds,
    )
    touched = motion_contact(plan, checker)
    if touched is not None:
        raise NoAnswerError(touched)
    return replace(plan, roll=roll_of(plan))
