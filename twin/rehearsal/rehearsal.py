"""A plan executed in the twin: the approach by motors, a pause, and the insertion, the patient at their true pose.

What is modelled: rigid bodies, gravity, motor lag and torque limits, joint offsets, a registration that errs; the
insertion by a spring at the tip, or by the motors (``[rehearsal] control``); where ``[tissue]`` is declared, its force
on the needle from the skin on, and the needle's deflection (as a displacement of the patient). What is not: tissue that
moves, breathing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.skin import skin_paths
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case, bed_frame
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.collision.workcell import case_boxes, case_checker, case_tool
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.search.bending import insertion_along
from puncture_twin.planning.sweep.sweep_planner import SweepPlan
from puncture_twin.twin.guidance.ct.needle import needle_error
from puncture_twin.twin.plant.true_needle import StraightPath, TissueForce, TrueTissue
from puncture_twin.twin.plant.truth import Truth
from puncture_twin.twin.rehearsal.result import Rehearsal, RehearsalContact
from puncture_twin.twin.world.client import TIME_STEP_S
from puncture_twin.twin.world.control import Insertion, insert
from puncture_twin.twin.world.execution import Execution, execute, joined
from puncture_twin.twin.world.workcell import open_workcell

CLEARANCE_SAMPLES = 48
"""Moments of the insertion at which the needle's clearance is measured, the last one included."""


def rehearse(plan: Plan, case: Case, anatomy: Anatomy, truth: Truth) -> Rehearsal:
    """Execute a plan where the ground truth differs from the belief; no randomness but that in ``truth``.

    Args:
        plan: What was planned on the belief.
        case: The case of the plan.
        truth: The patient's pose and the joints' offsets, already drawn.

    Raises:
        InputError: The twin has no body of this arm, or its base stands in the patient.
    """
    T_base_ct = truth.T_base_ct_true
    model = plan.model
    # 1. The simulator executes; 2. the true tip follows from its flange poses; 3. tip error, clearances, contacts.
    measured = executed(plan, case, anatomy, truth)
    done, phase = measured.execution, measured.phase
    times = done.times_s
    T_ct_flange = np.linalg.inv(T_base_ct) @ done.T_base_flange
    forward_ct = T_ct_flange[:, :3, 2]
    tip_ct = T_ct_flange[:, :3, 3] + plan.needle_length_mm * forward_ct
    samples = _clearance_samples(phase)
    target_ct = case.target_ct if truth.target_ct is None else truth.target_ct
    error = needle_error(tip_ct[-1], forward_ct[-1], target_ct)
    return Rehearsal(
        seed=truth.seed,
        truth_source=truth.source,
        T_base_ct_true=T_base_ct,
        times_s=times,
        q=done.q,
        q_command=done.q_command,
        phase=phase,
        T_base_flange_true=done.T_base_flange,
        tip_true_ct=tip_ct,
        clearance_times_s=times[samples],
        clearance_mm=_clearances(plan, case, anatomy, tip_ct[samples], forward_ct[samples]),
        contacts=_contacts(case, anatomy, truth, done, times, phase),
        max_joint_speed=done.max_speed,
        speed_limits=model.max_speeds.copy(),
        tip_error_mm=error.tip_to_target_mm,
        lateral_mm=error.lateral_mm,
        depth_mm=error.depth_mm,
        predicted_error_mm=plan.expected_target_error_mm,
        target_true_ct=target_ct.copy(),
        truth_is_belief=bool(np.array_equal(T_base_ct, plan.T_base_ct)),
        control=case.rehearsal.control,
        off_path_mm=measured.off_path_mm,
        tissue_force=measured.tissue_force,
    )


def _clearance_samples(phase: NDArray[np.str_]) -> NDArray[np.int64]:
    """Rows of the records at which clearance is measured: spread over the insertion, and the last of all."""
    candidates = np.append(np.flatnonzero(phase == "insertion"), len(phase) - 1)
    spread = np.round(np.linspace(0, len(candidates) - 1, CLEARANCE_SAMPLES)).astype(np.int64)
    return np.unique(candidates[spread])


def _clearances(
    plan: Plan, case: Case, anatomy: Anatomy, tips_ct: Floats, forward_ct: Floats
) -> MappingProxyType[str, Floats]:
    """Clearance of the needle from every structure at every sample, by FCL: axis distance minus radius, mm."""
    meshes = [structure.mesh for structure in anatomy.structures]
    bounds = [mesh.bounds for mesh in meshes]
    distance = np.empty((len(tips_ct), len(meshes)))
    engine = FclEngine(meshes)
    for row, (tip, forward) in enumerate(zip(tips_ct, forward_ct, strict=True)):
        distance[row] = engine.distances(tip, -forward, plan.needle_length_mm)
        for column, (mesh, (low, high)) in enumerate(zip(meshes, bounds, strict=True)):
            # FCL sees surfaces only; a needle may hide inside one
            may_hide = distance[row, column] > 0 and np.all((tip > low) & (tip < high))
            if may_hide and side_of(mesh, tip) is Side.INSIDE:
                distance[row, column] = 0.0
    clearance = distance - case.needle.radius_mm
    names = [structure.name for structure in anatomy.structures]
    return MappingProxyType(dict(zip(names, np.ascontiguousarray(clearance.T), strict=True)))


def _contacts(
    case: Case, anatomy: Anatomy, truth: Truth, done: Execution, times_s: Floats, phase: NDArray[np.str_]
) -> tuple[RehearsalContact, ...]:
    """Contacts by the physics at every step, and by FCL at every record, arm and patient at their true poses.

    Two sources, because each misses some: the physics lets the needle pass the skin and the arm pass itself, and
    simplifies large skins; FCL gives only the first contact of a record.
    """
    contacts = [RehearsalContact(t.time_s, t.link, t.body, t.depth_mm) for t in done.touches]
    checker = case_checker(case, anatomy, truth.T_base_ct_true)
    inside = (phase == "insertion") | (phase == "hold")
    for time, q, may_touch in zip(times_s.tolist(), done.q + truth.joint_offsets, inside.tolist(), strict=True):
        hit = checker.contact(q, needle_may_touch_patient=may_touch)
        if hit is not None:
            contacts.append(RehearsalContact(time, hit.body, hit.other, float("nan")))
    return _merged(contacts)


def _merged(contacts: Iterable[RehearsalContact]) -> tuple[RehearsalContact, ...]:
    """One contact for each pair of bodies: its first time, its greatest depth."""
    pairs: dict[tuple[str, str], RehearsalContact] = {}
    for contact in contacts:
        key = (contact.link, contact.body)
        old = pairs.get(key, contact)
        depth = float(np.fmax(old.depth_mm, contact.depth_mm))
        pairs[key] = RehearsalContact(min(old.time_s, contact.time_s), *key, depth)
    return tuple(sorted(pairs.values(), key=lambda contact: (contact.time_s, contact.link, contact.body)))


SETTLE_S = 0.5
"""Pause between approach and insertion, and about a sweep: ten times the time in which a motor's lag dies out."""

DWELL_S = 1.0
"""Pause at the end, before the tip is measured."""

ROUNDING = 1e-6
"""Tolerance of a time over the physics step: a whole number of steps must not fall short of itself."""


@dataclass(frozen=True, eq=False)
class Executed:
    """Measurements of the simulator.

    Attributes:
        phase: Shape (m,), of each record: "approach", "settle", "insertion" or "hold".
        off_path_mm: Largest distance of the tip from its commanded path, by the encoders, from the insertion on.
        tissue_force: The greatest forces of the tissue; None where none is declared.
    """

    execution: Execution
    phase: NDArray[np.str_]
    off_path_mm: float
    tissue_force: TissueForce | None


def executed(plan: Plan, case: Case, anatomy: Anatomy, truth: Truth) -> Executed:
    """Execute a plan in the simulator; arguments and errors as of `rehearse`."""
    T_base_ct, tissue = truth.T_base_ct_true, true_tissue(plan, case, anatomy, truth)
    model, tool, boxes = plan.model, case_tool(case), case_boxes(case, T_base_ct)
    down_ct = -bed_frame(case)[:3, 2]
    approach = steps(plan.approach)
    before = np.concatenate([approach, np.repeat(approach[-1:], round(SETTLE_S / TIME_STEP_S), axis=0)])
    start_s = TIME_STEP_S * len(before)
    with open_workcell(model, tool, anatomy.skin.mesh, T_base_ct, boxes, down_ct=down_ct) as workcell:
        # Joint position motors to the standoff and until they are still, then the insertion and its dwell.
        approached = execute(workcell, before, truth.joint_offsets)
        insertion = Insertion(model, tool, T_base_ct[:3, :3] @ down_ct, plan.insertion, DWELL_S)
        control = case.rehearsal.control
        inserted = insert(workcell, insertion, control, truth.joint_offsets, start_s=start_s, resistance=tissue)
    done = joined(approached, inserted.execution)
    ends = np.cumsum([len(approach), len(before) - len(approach), len(steps(plan.insertion))])
    row = np.floor(done.times_s / TIME_STEP_S + ROUNDING).astype(np.int64)
    phase = np.array(["approach", "settle", "insertion", "hold"])[np.searchsorted(ends, row, side="right")]
    tissue_force = None if case.bending is None else TissueForce(0.0, 0.0) if tissue is None else tissue.greatest
    return Executed(done, phase, inserted.off_path_mm, tissue_force)


def steps(trajectory: Trajectory) -> Floats:
    """A trajectory's joints at every step of the position motors, shape (n, 6), rad, its end included."""
    count = int(np.ceil(trajectory.duration_s / TIME_STEP_S)) + 1
    return trajectory.at(TIME_STEP_S * np.arange(count, dtype=np.float64))


def true_tissue(plan: Plan, case: Case, anatomy: Anatomy, truth: Truth) -> TrueTissue | None:
    """The declared tissue along the true axis of the needle; None where none is declared or the needle passes none."""
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
    """Measurements of a sweep without its approach; m records.

    Attributes:
        times_s: Shape (m,).
        off_mm: Shape (m,): distance of the virtual TCP from its point.
        contacts: Bodies that touched, such as ("forearm", "patient").
    """

    times_s: Floats
    off_mm: Floats
    contacts: tuple[tuple[str, str], ...]


def execute_sweep(plan: SweepPlan, case: Case, anatomy: Anatomy, T_base_ct: Floats) -> Swept:
    """Execute a sweep in the believed workcell: what is measured is control, by `[rehearsal] control` of the case.

    Args:
        plan: The motion.
        case: For tool, boxes, gravity and control.
        T_base_ct: Shape (4, 4), mm: where the patient lies.
    """
    tool, down_ct, still = case_tool(case), -bed_frame(case)[:3, 2], np.zeros(6)
    approach = steps(plan.approach)
    pause = np.repeat(approach[-1:], round(SETTLE_S / TIME_STEP_S), axis=0)
    before = np.concatenate([approach, pause])
    with open_workcell(
        plan.model, tool, anatomy.skin.mesh, T_base_ct, case_boxes(case, T_base_ct), down_ct=down_ct
    ) as workcell:
        first = execute(workcell, before, still)
        motion = Insertion(plan.model, tool, T_base_ct[:3, :3] @ down_ct, plan.sweep, SETTLE_S)
        done = insert(workcell, motion, case.rehearsal.control, still, start_s=len(before) * TIME_STEP_S).execution
    contacts = tuple(dict.fromkeys((one.link, one.body) for one in (*first.touches, *done.touches)))
    return Swept(done.times_s, plan.off_point_mm(done.T_base_flange), contacts)
