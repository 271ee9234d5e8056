"""A sweep executed in the simulator: how far its virtual TCP leaves the point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.bed import bed_frame
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.surroundings import case_boxes
from puncture_twin.planning.collision.workcell import case_tool
from puncture_twin.planning.sweep.sweep_plan import SweepPlan
from puncture_twin.twin.rehearsal.executed import steps
from puncture_twin.twin.world.client import TIME_STEP_S
from puncture_twin.twin.world.control.insertion import Insertion, insert
from puncture_twin.twin.world.execution import execute
from puncture_twin.twin.world.workcell import open_workcell

SETTLE_S = 0.5
"""Pause before the sweep, and after it."""


@dataclass(frozen=True, eq=False)
class Swept:
    """What was measured of the sweep, its approach left out; m records.

    Attributes:
        times_s: Shape (m,).
        off_mm: Shape (m,): of the virtual TCP from its point.
        contacts: Bodies that touched, such as ("forearm", "patient").
    """

    times_s: Floats
    off_mm: Floats
    contacts: tuple[tuple[str, str], ...]


def execute_sweep(plan: SweepPlan, case: Case, anatomy: Anatomy, T_base_ct: Floats) -> Swept:
    """Sweep in the workcell as it is believed: what is measured is control, by `[rehearsal] control` of the case.

    Args:
        plan: The motion.
        case: For tool, boxes, gravity and control.
        anatomy: For the skin.
        T_base_ct: Shape (4, 4), mm: where the patient lies.
    """
    tool, down_ct, still = case_tool(case), -bed_frame(case)[:3, 2], np.zeros(6)
    approach = steps(plan.approach)
    pause = np.repeat(approach[-1:], round(SETTLE_S / TIME_STEP_S), axis=0)
    before = np.concatenate([approach, pause])
    with open_workcell(
        plan.model, tool, anatomy.skin.mesh, T_base_ct, case_boxes(case, T_base_ct), down_ct=down_ct
    ) as room:
        first = execute(room, before, still)
        motion = Insertion(plan.model, tool, T_base_ct[:3, :3] @ down_ct, plan.sweep, SETTLE_S)
        done = insert(room, motion, case.rehearsal.control, still, start_s=len(before) * TIME_STEP_S).execution
    contacts = tuple(dict.fromkeys((one.link, one.body) for one in (*first.touches, *done.touches)))
    return Swept(done.times_s, plan.off_point_mm(done.T_base_flange), contacts)
