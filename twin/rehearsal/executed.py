"""A plan's motions in the simulator: the approach by position motors, a pause, and the insertion as the case wants it.

Where the case declares tissue, it presses on the needle from the skin on, whoever controls the insertion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.skin_entry import skin_paths
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.bed import bed_frame
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.surroundings import case_boxes
from puncture_twin.planning.collision.workcell import case_tool
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.search.bending.insertion import insertion_along
from puncture_twin.planning.sweep.sweep_plan import SweepPlan
from puncture_twin.twin.plant.felt import Felt
from puncture_twin.twin.plant.true_tissue import StraightPath, TrueTissue
from puncture_twin.twin.plant.truth import Truth
from puncture_twin.twin.world.client import TIME_STEP_S
from puncture_twin.twin.world.control.insertion import Insertion, insert
from puncture_twin.twin.world.execution import Execution, execute, joined
from puncture_twin.twin.world.workcell import open_workcell

SETTLE_S = 0.5
"""Pause between approach and insertion, and about a sweep: ten times the time in which a motor's lag dies out."""

DWELL_S = 1.0
"""Pause at the end, before the tip is measured."""

ROUNDING = 1e-6
"""Of a time over the physics step: a whole number of steps must not fall short of itself."""


@dataclass(frozen=True, eq=False)
class Executed:
    """What the simulator measured.

    Attributes:
        execution: Its records.
        phase: Shape (m,), of each record: "approach", "settle", "insertion" or "hold".
        off_path_mm: Of the tip from its commanded path, by the encoders, at most from the insertion on.
        felt: The greatest forces of the tissue; None where none was declared.
    """

    execution: Execution
    phase: NDArray[np.str_]
    off_path_mm: float
    felt: Felt | None


def executed(plan: Plan, case: Case, anatomy: Anatomy, truth: Truth) -> Executed:
    """Execute a plan; arguments and errors as of `rehearse`."""
    T_base_ct, tissue = truth.T_base_ct_true, true_tissue(plan, case, anatomy, truth)
    model, tool, boxes = plan.model, case_tool(case), case_boxes(case, T_base_ct)
    down_ct = -bed_frame(case)[:3, 2]
    approach = steps(plan.approach)
    before = np.concatenate([approach, np.repeat(approach[-1:], round(SETTLE_S / TIME_STEP_S), axis=0)])
    start_s = TIME_STEP_S * len(before)
    with open_workcell(model, tool, anatomy.skin.mesh, T_base_ct, boxes, down_ct=down_ct) as room:
        approached = execute(room, before, truth.joint_offsets)
        insertion = Insertion(model, tool, T_base_ct[:3, :3] @ down_ct, plan.insertion, DWELL_S)
        how = case.rehearsal.control
        inserted = insert(room, insertion, how, truth.joint_offsets, start_s=start_s, resistance=tissue)
    done = joined(approached, inserted.execution)
    ends = np.cumsum([len(approach), len(before) - len(approach), len(steps(plan.insertion))])
    row = np.floor(done.times_s / TIME_STEP_S + ROUNDING).astype(np.int64)
    phase = np.array(["approach", "settle", "insertion", "hold"])[np.searchsorted(ends, row, side="right")]
    felt = None if case.bending is None else Felt(0.0, 0.0) if tissue is None else tissue.felt
    return Executed(done, phase, inserted.off_path_mm, felt)


def steps(trajectory: Trajectory) -> Floats:
    """A trajectory at every step of the position motors, shape (n, 6), its end included."""
    count = int(np.ceil(trajectory.duration_s / TIME_STEP_S)) + 1
    return trajectory.at(TIME_STEP_S * np.arange(count, dtype=np.float64))


def true_tissue(plan: Plan, case: Case, anatomy: Anatomy, truth: Truth) -> TrueTissue | None:
    """The declared tissue on the axis that the plan's needle truly takes; None without tissue, or where it meets none.

    Args:
        plan: What is executed.
        case: The case of the plan.
        anatomy: Its structures.
        truth: Where the patient lies.
    """
    if case.bending is None:
        return None
    T_base_flange = flange_pose(plan.model, plan.insertion.q[-1] + truth.joint_offsets)
    T_ct_base = np.linalg.inv(truth.T_base_ct_true)
    into_base = T_base_flange[:3, 2]
    end_ct = apply(T_ct_base, T_base_flange[:3, 3] + plan.needle_length_mm * into_base)
    outward_ct = -T_ct_base[:3, :3] @ into_base
    found = skin_paths(anatomy.skin, end_ct, outward_ct[None], plan.needle_length_mm)
    length = float(found.path_length[0])
    if not np.isfinite(length):
        return None
    path = StraightPath(apply(truth.T_base_ct_true, end_ct + length * outward_ct), into_base)
    along = insertion_along(case.bending, anatomy, end_ct, outward_ct, length)
    return TrueTissue(along, path, truth.bevel_side, case.bending.shaft.length_mm)


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
