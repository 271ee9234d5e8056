"""A plan, executed in the twin: the arm moves under its motors, the patient lies at their true place.

What is modelled: rigid bodies, gravity, motor lag and torque limits, joint offsets, a registration that errs; the
insertion by a spring at the tip, or by the motors (``[rehearsal] control``); where ``[tissue]`` is declared, its force
on the needle, and how far the needle bends, in where the patient lies. What is not: tissue that moves, breathing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.collision.workcell import case_checker
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.twin.plant.truth import Truth
from puncture_twin.twin.rehearsal.executed import executed
from puncture_twin.twin.rehearsal.result import Rehearsal, RehearsalContact
from puncture_twin.twin.world.execution import Execution

CLEARANCE_SAMPLES = 48
"""Moments of the insertion at which the needle's clearance is measured, the last one included."""


@dataclass(frozen=True)
class TipError:
    """Where a needle ended, seen from the target; mm. total^2 = lateral^2 + depth^2."""

    total_mm: float
    lateral_mm: float
    depth_mm: float


def rehearse(plan: Plan, case: Case, anatomy: Anatomy, truth: Truth, engine: FclEngine | None = None) -> Rehearsal:
    """Execute a plan where the truth differs from the belief. The same plan and truth give the same numbers.

    Args:
        plan: What was planned on the belief.
        case: The case of the plan.
        anatomy: Its structures.
        truth: Where the patient lies and what the joints do; all randomness is in it.
        engine: Of the anatomy's structures, in their order, where it is at hand.

    Raises:
        InputError: The twin has no body of this arm, or its base stands in the patient.
    """
    T_base_ct = truth.T_base_ct_true
    model = plan.model
    seen = executed(plan, case, anatomy, truth)
    done, phase = seen.execution, seen.phase
    times = done.times_s
    T_ct_flange = np.linalg.inv(T_base_ct) @ done.T_base_flange
    forward_ct = T_ct_flange[:, :3, 2]
    tip_ct = T_ct_flange[:, :3, 3] + plan.needle_length_mm * forward_ct
    samples = _clearance_samples(phase)
    target_ct = case.target_ct if truth.target_ct is None else truth.target_ct
    error = split_error(tip_ct[-1], forward_ct[-1], target_ct)
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
        clearance_mm=_clearances(plan, case, anatomy, tip_ct[samples], forward_ct[samples], engine),
        contacts=_contacts(case, anatomy, truth, done, times, phase),
        max_joint_speed=done.max_speed,
        speed_limits=model.max_speeds.copy(),
        tip_error_mm=error.total_mm,
        lateral_mm=error.lateral_mm,
        depth_mm=error.depth_mm,
        predicted_error_mm=plan.expected_target_error_mm,
        target_true_ct=target_ct.copy(),
        truth_is_belief=bool(np.array_equal(T_base_ct, plan.T_base_ct)),
        control=case.rehearsal.control,
        off_path_mm=seen.off_path_mm,
        felt=seen.felt,
    )


def split_error(tip: Floats, forward: Floats, target: Floats) -> TipError:
    """Tip minus target, split along and across the needle.

    Args:
        tip: Shape (3,), mm, any frame.
        forward: Shape (3,), unit vector from the needle's top to its tip, same frame.
        target: Shape (3,), mm, same frame.
    """
    error = tip - target
    depth = float(error @ forward)
    return TipError(float(np.linalg.norm(error)), float(np.linalg.norm(error - depth * forward)), depth)


def _clearance_samples(phase: NDArray[np.str_]) -> NDArray[np.int64]:
    """Records spread over the insertion, and the last of all."""
    candidates = np.append(np.flatnonzero(phase == "insertion"), len(phase) - 1)
    spread = np.round(np.linspace(0, len(candidates) - 1, CLEARANCE_SAMPLES)).astype(np.int64)
    return np.unique(candidates[spread])


def _clearances(
    plan: Plan, case: Case, anatomy: Anatomy, tips_ct: Floats, forward_ct: Floats, engine: FclEngine | None
) -> MappingProxyType[str, Floats]:
    """FCL's distance of the needle's axis to every structure, at every sample, minus the radius."""
    meshes = [structure.mesh for structure in anatomy.structures]
    bounds = [mesh.bounds for mesh in meshes]
    distance = np.empty((len(tips_ct), len(meshes)))
    engine = engine or FclEngine(meshes)
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
    """What the physics felt at every step, and what FCL finds at every record, arm and patient where they truly were.

    The physics lets the needle pass the skin and the arm pass itself, and rounds large skins; FCL says the first
    contact of a record only.
    """
    seen = [RehearsalContact(t.time_s, t.link, t.body, t.depth_mm) for t in done.touches]
    checker = case_checker(case, anatomy, truth.T_base_ct_true)
    inside = (phase == "insertion") | (phase == "hold")
    for time, q, may_touch in zip(times_s.tolist(), done.q + truth.joint_offsets, inside.tolist(), strict=True):
        hit = checker.contact(q, needle_may_touch_patient=may_touch)
        if hit is not None:
            seen.append(RehearsalContact(time, hit.body, hit.other, float("nan")))
    return _merged(seen)


def _merged(contacts: Iterable[RehearsalContact]) -> tuple[RehearsalContact, ...]:
    """One contact for each pair of bodies: its first time, its greatest depth."""
    pairs: dict[tuple[str, str], RehearsalContact] = {}
    for contact in contacts:
        key = (contact.link, contact.body)
        old = pairs.get(key, contact)
        depth = float(np.fmax(old.depth_mm, contact.depth_mm))
        pairs[key] = RehearsalContact(min(old.time_s, contact.time_s), *key, depth)
    return tuple(sorted(pairs.values(), key=lambda contact: (contact.time_s, contact.link, contact.body)))
