"""A plan executed in the twin: the approach by motors, a pause, and the insertion, the patient at their true pose.

Modelled are rigid bodies, gravity, motor lag and torque limits, joint offsets, a registration that errs, and where
``[tissue]`` is declared its force on the needle and the needle's deflection (as a displacement of the patient). Not
modelled: tissue that moves, breathing.
"""

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
from puncture_twin.twin.plant.true_needle import TissueForce, TrueTissue
from puncture_twin.twin.plant.truth import Truth
from puncture_twin.twin.rehearsal.result import Rehearsal
from puncture_twin.twin.world.client import TIME_STEP_S
from puncture_twin.twin.world.control import insert, rigid_model
from puncture_twin.twin.world.execution import ContactEvent, Execution, execute, joined
from puncture_twin.twin.world.workcell import open_workcell

CLEARANCE_SAMPLES = 48
"""Moments of the insertion at which the needle's clearance is measured, the last one included."""


def rehearse(plan: Plan, case: Case, anatomy: Anatomy, truth: Truth) -> Rehearsal:
    """Execute a plan where the ground truth differs from the belief; no randomness but that in ``truth``."""
    T_base_ct, tissue = truth.T_base_ct_true, true_tissue(plan, case, anatomy, truth)
    # 1. The simulator executes; 2. the true tip follows from its flange poses; 3. tip error, clearances, contacts.
    offsets = truth.joint_offsets
    done, off_path_mm = _executed(case, anatomy, T_base_ct, plan, plan.insertion, DWELL_S, offsets, tissue)
    force = None if case.bending is None else TissueForce(0.0, 0.0) if tissue is None else tissue.greatest
    T_ct_flange = np.linalg.inv(T_base_ct) @ done.T_base_flange
    forward_ct = T_ct_flange[:, :3, 2]
    tip_ct = T_ct_flange[:, :3, 3] + plan.needle_length_mm * forward_ct
    times, phase = done.times_s, _phases(plan, done.times_s)
    inserting = np.append(np.flatnonzero(phase == "insertion"), len(phase) - 1)  # and the last record of all
    spread = np.round(np.linspace(0, len(inserting) - 1, CLEARANCE_SAMPLES)).astype(np.int64)
    samples = np.unique(inserting[spread])
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
        contacts=_contacts(case, anatomy, truth, done, phase),
        max_joint_speed=done.max_speed,
        speed_limits=plan.model.max_speeds.copy(),
        tip_error_mm=error.tip_to_target_mm,
        lateral_mm=error.lateral_mm,
        depth_mm=error.depth_mm,
        predicted_error_mm=plan.expected_target_error_mm,
        target_true_ct=target_ct.copy(),
        truth_is_belief=bool(np.array_equal(T_base_ct, plan.T_base_ct)),
        control=case.rehearsal.control,
        off_path_mm=off_path_mm,
        tissue_force=force,
    )


def _phases(plan: Plan, times_s: Floats) -> NDArray[np.str_]:
    approach, insertion = len(steps(plan.approach)), len(steps(plan.insertion))
    row = np.floor(times_s / TIME_STEP_S + ROUNDING).astype(np.int64)
    ends = np.cumsum([approach, SETTLE_STEPS, insertion])
    return np.array(["approach", "settle", "insertion", "hold"])[np.searchsorted(ends, row, side="right")]


def _clearances(
    plan: Plan, case: Case, anatomy: Anatomy, tips_ct: Floats, forward_ct: Floats
) -> MappingProxyType[str, Floats]:
    """Clearance of the needle from every structure at every sample, by FCL: axis distance minus radius, mm."""
    meshes = {structure.name: structure.mesh for structure in anatomy.structures}
    engine, distance = FclEngine(list(meshes.values())), np.empty((len(tips_ct), len(meshes)))
    for row, (tip, forward) in enumerate(zip(tips_ct, forward_ct, strict=True)):
        distance[row] = engine.distances(tip, -forward, plan.needle_length_mm)
        for column, mesh in enumerate(meshes.values()):
            # FCL sees surfaces only; a needle may hide inside one
            may_hide = distance[row, column] > 0 and np.all((tip > mesh.bounds[0]) & (tip < mesh.bounds[1]))
            if may_hide and side_of(mesh, tip) is Side.INSIDE:
                distance[row, column] = 0.0
    clearance = np.ascontiguousarray((distance - case.needle.radius_mm).T)
    return MappingProxyType(dict(zip(meshes, clearance, strict=True)))


def _contacts(
    case: Case, anatomy: Anatomy, truth: Truth, done: Execution, phase: NDArray[np.str_]
) -> tuple[ContactEvent, ...]:
    """Contacts by the physics at every step, and by FCL at every record, arm and patient at their true poses.

    Two sources, because each misses some: the physics lets the needle pass the skin and the arm pass itself, and
    simplifies large skins; FCL gives only the first contact of a record.
    """
    contacts = list(done.touches)
    checker = case_checker(case, anatomy, truth.T_base_ct_true)
    inside = (phase == "insertion") | (phase == "hold")
    for time, q, may_touch in zip(done.times_s.tolist(), done.q + truth.joint_offsets, inside.tolist(), strict=True):
        hit = checker.contact(q, needle_may_touch_patient=may_touch)
        if hit is not None:
            contacts.append(ContactEvent(time, hit.body, hit.other, float("nan")))
    pairs: dict[tuple[str, str], ContactEvent] = {}  # each with its first time, and its greatest depth
    for contact in contacts:
        key = (contact.link, contact.body)
        old = pairs.get(key, contact)
        depth = float(np.fmax(old.depth_mm, contact.depth_mm))
        pairs[key] = ContactEvent(min(old.time_s, contact.time_s), *key, depth)
    return tuple(sorted(pairs.values(), key=lambda contact: (contact.time_s, contact.link, contact.body)))


SETTLE_S, SETTLE_STEPS = 0.5, round(0.5 / TIME_STEP_S)
"""Pause between approach and insertion, and about a sweep: ten times the time in which a motor's lag dies out."""
DWELL_S = 1.0
"""Pause at the end, before the tip is measured."""
ROUNDING = 1e-6
"""Tolerance of a time over the physics step: a whole number of steps must not fall short of itself."""


def _executed(
    case: Case, anatomy: Anatomy, T_base_ct: Floats, plan: Plan | SweepPlan, motion: Trajectory, hold_s: float,
    joint_offsets: Floats, tissue: TrueTissue | None = None,
) -> tuple[Execution, float]:  # fmt: skip
    """The approach by motors until they are still, then a motion of the tip and its dwell; how far it erred, mm."""
    model, tool, down_ct = plan.model, case_tool(case), -bed_frame(case)[:3, 2]
    approach = steps(plan.approach)
    before = np.concatenate([approach, np.repeat(approach[-1:], SETTLE_STEPS, axis=0)])
    boxes, start_s = case_boxes(case, T_base_ct), TIME_STEP_S * len(before)
    with open_workcell(model, tool, anatomy.skin.mesh, T_base_ct, boxes, down_ct=down_ct) as workcell:
        approached = execute(workcell, before, joint_offsets)
        with rigid_model(model, tool, T_base_ct[:3, :3] @ down_ct) as rigid:
            how = case.rehearsal.control, joint_offsets, hold_s, start_s, tissue
            inserted, off_path_mm = insert(workcell, rigid, motion, *how)
    return joined(approached, inserted), off_path_mm


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
    paths = skin_paths(anatomy.skin, end_ct, outward_ct[None], plan.needle_length_mm)
    length = float(paths.path_length[0])
    if not np.isfinite(length):
        return None
    entry_base = apply(truth.T_base_ct_true, end_ct + length * outward_ct)
    along = insertion_along(case.bending, anatomy, end_ct, outward_ct, length)
    return TrueTissue(along, entry_base, into_base, truth.bevel_side, case.bending.shaft.length_mm)


@dataclass(frozen=True, eq=False)
class Swept:
    """Measurements of a sweep without its approach; `off_mm` (m,) is the virtual TCP's distance from its point."""

    times_s: Floats  # shape (m,)
    off_mm: Floats
    contacts: tuple[tuple[str, str], ...]


def execute_sweep(plan: SweepPlan, case: Case, anatomy: Anatomy, T_base_ct: Floats) -> Swept:
    """Execute a sweep, the patient at T_base_ct (4, 4), mm, as believed: what is measured is the case's control."""
    done, _ = _executed(case, anatomy, T_base_ct, plan, plan.sweep, SETTLE_S, np.zeros(6))
    begun_s = TIME_STEP_S * (len(steps(plan.approach)) + SETTLE_STEPS - ROUNDING)
    sweeping = done.times_s >= begun_s
    contacts = tuple(dict.fromkeys((one.link, one.body) for one in done.touches))
    return Swept(done.times_s[sweeping], plan.off_point_mm(done.T_base_flange[sweeping]), contacts)
