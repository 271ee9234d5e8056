"""Punctures in the simulator whose truth something else has drawn: touches of the same erring arm, or rooms.

The simulated arm is the nominal one. What its lengths and the needle err by at the target becomes a part of where the
patient lies, as in `plan_truth`; the error of the joints on arrival stays one of joints.
"""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.twin.plant.touch_truth import AtTarget, TouchTruth
from puncture_twin.twin.plant.true_needle import true_needle
from puncture_twin.twin.plant.truth import Truth
from puncture_twin.twin.rehearsal.distribution import Distribution, PhysicsRooms
from puncture_twin.twin.rehearsal.plan_truth import bent_truth, drawn_truth, spread_rows
from puncture_twin.twin.rehearsal.rehearsal import rehearse
from puncture_twin.twin.rehearsal.result import Rehearsal


def rehearse_touched(context: CaseContext, plan: Plan, truth: TouchTruth, at_target: AtTarget) -> Rehearsal:
    """Execute the puncture of touches where everything truly is. The same arguments give the same numbers.

    Args:
        context: The case.
        plan: By the registration of the touches.
        truth: That the touches met.
        at_target: What is true on arrival.
    """
    met = bent_truth(context, plan, puncture_truth(plan, truth, at_target))
    return rehearse(plan, context.case, context.anatomy, met)


def puncture_truth(plan: Plan, truth: TouchTruth, at_target: AtTarget) -> Truth:
    """The truth of touches for a simulated arm that is nominal but for its joints; arguments as above."""
    model, q = plan.model, plan.insertion.q[-1] + at_target.arrival
    nominal = np.array(flange_pose(model, q))
    nominal[:3, 3] += plan.needle_length_mm * nominal[:3, 2]
    needle = true_needle(model, q, truth.eta, plan.needle_length_mm)
    T_base_ct = nominal @ np.linalg.inv(pose(needle.R_base_needle, needle.tip_base)) @ truth.T_base_ct
    source = f"that of the touches, drawn with seed {truth.seed}"
    return Truth(T_base_ct, at_target.arrival, truth.seed, source, at_target.target_ct)


def physics_rooms(context: CaseContext, plan: Plan, found: Distribution, count: int, progress: Count) -> PhysicsRooms:
    """Run some of the rooms, spread evenly over the order of their tip errors, in the simulator.

    Args:
        context: The plan's case.
        plan: What is executed.
        found: The rooms; the arm reached the pose in one at least.
        count: How many.
        progress: Called with rooms done and all of them.
    """
    rows = spread_rows(found, count)
    apart, contacts = np.empty(len(rows)), 0
    for number, row in enumerate(rows.tolist()):
        truth = drawn_truth(found.puncture, found.rooms, row, found.seed, "a room")
        done = rehearse(plan, context.case, context.anatomy, truth)
        apart[number] = np.linalg.norm(done.tip_true_ct[-1] - found.rooms.tip_ct[row])
        contacts += bool(done.contacts)
        progress(number + 1, len(rows))
    return PhysicsRooms(apart, contacts)
