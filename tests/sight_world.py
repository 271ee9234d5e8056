"""Plans for what sees the needle: a straight insertion of a checked direction, without the approach's planner."""

import numpy as np

from puncture_twin.planning.arm.inverse_kinematics import branch_of, inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.reach.standoff import standoffs


def straight_plan(context, theta_deg, beta_deg, samples=41):
    """The plan of a direction that is safe; its approach is the standoff alone."""
    case, T, model = context.case, context.placement.T_base_ct, context.case.robot.model
    found = context.check(*np.radians([theta_deg, beta_deg]))
    assert found.safe[0], found.verdict
    q_end, branch = found.arm.q_insertion[0], branch_of(model, found.arm.q_insertion)[0]
    standoff = float(standoffs(case.needle, found.path.length, found.path.skin_angle)[0])
    poses = np.repeat(flange_pose(model, q_end)[None], samples, axis=0)
    poses[:, :3, 3] += np.linspace(0.0, standoff, samples)[:, None] * (T[:3, :3] @ found.outward_ct[0])
    q = [q_end]
    for solutions in inverse(model, poses)[1:]:
        q.append(nearest_within_limits(model, solutions[branch], q[-1]))
    q = np.array(q[::-1])
    return Plan(
        case_name=case.name, inputs=case.inputs, seed=0, model=model, T_base_ct=T, expected_target_error_mm=1.0,
        theta=float(found.theta[0]), beta=float(found.beta[0]), entry_ct=found.path.entry_ct[0],
        target_ct=case.target_ct, outward_ct=found.outward_ct[0], roll=0.0, standoff_mm=standoff,
        needle_length_mm=case.needle.length_mm, approach=Trajectory(np.zeros(1), q[:1]),
        insertion=Trajectory(np.linspace(0.0, 8.0, samples), q), clearance_mm={}, warnings=(),
    )  # fmt: skip
