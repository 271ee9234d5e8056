"""Rooms that were rehearsed by kinematics alone, run again in the simulator: do their tips end at the same place?"""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.twin.rehearsal.distribution import Distribution, PhysicsRooms
from puncture_twin.twin.rehearsal.plan_truth import drawn_truth, spread_rows
from puncture_twin.twin.rehearsal.rehearsal import rehearse


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
