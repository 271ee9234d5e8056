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
from puncture_twin.twin.plant.true_tissue import NOT_FELT, Felt
from puncture_twin.twin.plant.truth import Truth
from puncture_twin.twin.rehearsal.executed import executed
from puncture_twin.twin.rehearsal.standing import Standing
from puncture_twin.twin.world.execution import Execution

CONTROLS = MappingProxyType(
    {
        "impedance": "by a spring at the tip (impedance)",
        "admittance": "by moved goals of the motors (admittance)",
        "position": "by the position motors",
    }
)
"""How an insertion is followed, in words."""

CLEARANCE_SAMPLES = 48
"""Moments of the insertion at which the needle's clearance is measured, the last one included."""


@dataclass(frozen=True)
class RehearsalContact:
    """A body of the arm that touched something.

    Attributes:
        time_s: When it was first seen.
        link: The arm's body.
        body: What it touched: ``patient``, a box, or another body of the arm.
        depth_mm: Deepest overlap in the physics; NaN where only FCL saw it (it says whether, not how deep).
    """

    time_s: float
    link: str
    body: str
    depth_mm: float


@dataclass(frozen=True, eq=False)
class Rehearsal:
    """What was measured; m records in time, k samples of clearance. Angles in rad, lengths in mm.

    Attributes:
        seed: What the truth was drawn from.
        truth_source: How the truth was found.
        T_base_ct_true: Shape (4, 4), where the patient truly lay.
        times_s: Shape (m,), from the start of the approach.
        q: Shape (m, 6), what the encoders said.
        q_command: Shape (m, 6), what was asked.
        phase: Shape (m,), "approach", "settle", "insertion" or "hold".
        T_base_flange_true: Shape (m, 4, 4), where the flange truly was.
        tip_true_ct: Shape (m, 3), the needle's true tip in the patient.
        clearance_times_s: Shape (k,), moments of the insertion and its end.
        clearance_mm: Structure to shape (k,): true needle's axis to true structure, minus the needle's radius.
        contacts: One for each pair of bodies that touched, in the order of time.
        max_joint_speed: Shape (6,), rad/s.
        speed_limits: Shape (6,), rad/s.
        tip_error_mm: True tip to true target at the end.
        lateral_mm: Its part across the needle.
        depth_mm: Its part along the needle, positive when too deep.
        predicted_error_mm: What the plan expected (rms), NaN without markers.
        target_true_ct: Shape (3,), where the target truly was in the CT.
        truth_is_belief: Whether the patient lay exactly where it was believed, so that the error says little.
        control: How the insertion was followed: "impedance", "admittance" or "position".
        off_path_mm: The tip from its commanded path, by the encoders, at most from the insertion on.
        felt: The greatest forces of the tissue on the needle; None where the case declares none.
        standing: Where the error stands among others; None where the case declares no errors.
    """

    seed: int
    truth_source: str
    T_base_ct_true: Floats
    times_s: Floats
    q: Floats
    q_command: Floats
    phase: NDArray[np.str_]
    T_base_flange_true: Floats
    tip_true_ct: Floats
    clearance_times_s: Floats
    clearance_mm: MappingProxyType[str, Floats]
    contacts: tuple[RehearsalContact, ...]
    max_joint_speed: Floats
    speed_limits: Floats
    tip_error_mm: float
    lateral_mm: float
    depth_mm: float
    predicted_error_mm: float
    target_true_ct: Floats
    truth_is_belief: bool
    control: str
    off_path_mm: float
    felt: Felt | None
    standing: Standing | None = None

    @property
    def followed_text(self) -> str:
        """How the insertion was followed, for a person."""
        return f"{CONTROLS[self.control]}, at most {self.off_path_mm:.3f} mm off its commanded path"

    @property
    def force_text(self) -> str:
        """What the tissue did, for a person."""
        return NOT_FELT if self.felt is None else self.felt.text

    def __post_init__(self) -> None:
        for value in (*vars(self).values(), *self.clearance_mm.values()):
            if isinstance(value, np.ndarray):
                value.setflags(write=False)


@dataclass(frozen=True)
class TipError:
    """Where a needle ended, seen from the target; mm. total^2 = lateral^2 + depth^2."""

    total_mm: float
    lateral_mm: float
    depth_mm: float


def rehearse(plan: Plan, case: Case, anatomy: Anatomy, truth: Truth) -> Rehearsal:
    """Execute a plan where the truth differs from the belief. The same plan and truth give the same numbers.

    Args:
        plan: What was planned on the belief.
        case: The case of the plan.
        anatomy: Its structures.
        truth: Where the patient lies and what the joints do; all randomness is in it.

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
        clearance_mm=_clearances(plan, case, anatomy, tip_ct[samples], forward_ct[samples]),
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
    plan: Plan, case: Case, anatomy: Anatomy, tips_ct: Floats, forward_ct: Floats
) -> MappingProxyType[str, Floats]:
    """FCL's distance of the needle's axis to every structure, at every sample, minus the radius."""
    meshes = [structure.mesh for structure in anatomy.structures]
    bounds = [mesh.bounds for mesh in meshes]
    distance = np.empty((len(tips_ct), len(meshes)))
    engine = FclEngine(meshes) if meshes else None
    for row, (tip, forward) in enumerate(zip(tips_ct, forward_ct, strict=True)):
        if engine is not None:
            distance[row] = engine.measure(tip, -forward[None], plan.needle_length_mm).distance[0]
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
