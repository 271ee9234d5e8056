"""Skin and organs at every phase of the breath, if the needle is inserted at that phase.

At the position s the target is at t + s b d, and a structure of weight w is displaced by s w b d. Seen from the
structure, the needle starts at t + s b (1 - w) d: the surfaces stay where they are, and the engine prepared for them is
asked for another target. What moves with the target (w = 1) is not measured again.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.anatomy.skin_entry import SkinPaths, skin_paths, view_depth
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.reasons import REASON_TEXT, Reason
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.clearance.engine import ClearanceEngine
from puncture_twin.planning.clearance.measure import Clearances, measure
from puncture_twin.planning.needle.deflection import DeflectionBound
from puncture_twin.planning.reach.standoff import axis_lengths, farthest_flange
from puncture_twin.planning.search.bending.bent_needle import bent_verdict
from puncture_twin.planning.search.candidates import BreathingColumns, Candidates, Verdict
from puncture_twin.planning.search.constraints import first_broken
from puncture_twin.planning.search.phases.moving_weights import moving_weights

CLEARANCES = (Reason.TOO_CLOSE.value, Reason.UNKNOWN_REGION.value, Reason.NEEDLE_BENDS.value)
"""Reasons whose number is a clearance, the only one that is told of a phase."""


class _Phase(NamedTuple):
    """What m candidates are at one position s: the least clearance and its excess over a margin, shape (m,), mm."""

    verdict: Verdict
    clearance: Floats
    excess: Floats


def with_breathing(
    case: Case, anatomy: Anatomy, engine: ClearanceEngine, found: Candidates, bound: DeflectionBound | None = None
) -> Candidates:
    """Check what is safe at every phase, and reject what is not at one that the gate lets through.

    Args:
        case: The case; nothing is done where it declares no breathing.
        anatomy: Its structures.
        engine: Prepared for the meshes of ``anatomy.checked``, in that order.
        found: Checked where the CT shows the body.
        bound: How far the needle may bend; None bends nothing.

    Raises:
        InputError: See `moving_weights`.
    """
    breathing = case.breathing
    if breathing is None:
        return found
    rows = np.flatnonzero(found.safe)
    blank = np.full(len(found), np.nan)
    safe_all, worst, clearance = np.zeros(len(found), bool), blank.copy(), blank.copy()
    phases = [_at_phase(case, breathing, anatomy, engine, found, rows, s, bound) for s in breathing.positions.tolist()]
    safe = np.array([phase.verdict.reason == Reason.NONE.value for phase in phases])
    safe_all[rows] = safe.all(axis=0)
    window = np.flatnonzero(breathing.in_window)
    excess = np.array([phases[at].excess for at in window])
    worst[rows] = breathing.positions[window][excess.argmin(axis=0)]
    clearance[rows] = np.array([phases[at].clearance for at in window]).min(axis=0)
    columns = BreathingColumns(safe_all, worst, clearance, breathing.window_text)
    verdict = found.verdict
    for at in window:
        verdict = rejected_at(verdict, rows, phases[at].verdict, breathing, float(breathing.positions[at]))
    return replace(found, verdict=verdict, breathing=columns)


def rejected_at(verdict: Verdict, rows: Ints, at_phase: Verdict, breathing: Breathing, s: float) -> Verdict:
    """A verdict with what is rejected at one phase; what is rejected already keeps its reason.

    Args:
        verdict: Of n candidates.
        rows: Shape (m,), those that were checked at the phase.
        at_phase: Of these m.
        breathing: For the words.
        s: The phase's position.
    """
    new = (at_phase.reason != Reason.NONE.value) & (verdict.reason[rows] == Reason.NONE.value)
    arrays = {field.name: getattr(verdict, field.name).copy() for field in fields(verdict)}
    near = np.isin(at_phase.reason[new], CLEARANCES)
    arrays["structure"][rows[new]], arrays["depth"][rows[new]] = at_phase.structure[new], at_phase.depth[new]
    arrays["amount"][rows[new]] = np.where(near, at_phase.amount[new], np.nan)
    arrays["reason"][rows[new]] = Reason.UNSAFE_WHEN_BREATHING.value
    for row, reason, more in zip(rows[new], at_phase.reason[new], at_phase.detail[new], strict=True):
        arrays["detail"][row] = f"at {breathing.phase_text(s)}: {REASON_TEXT[Reason(reason)]}{more and f', {more}'}"
    return Verdict(**arrays)


def _at_phase(
    case: Case,
    breathing: Breathing,
    anatomy: Anatomy,
    engine: ClearanceEngine,
    found: Candidates,
    rows: Ints,
    s: float,
    bound: DeflectionBound | None,
) -> _Phase:
    weights, needle = moving_weights(case, breathing, anatomy), case.needle
    outward, moved = found.outward_ct[rows], breathing.moved_ct(s)
    paths = paths_at(case, anatomy.skin, outward, weights.skin, moved)
    clearances = _clearances(case, anatomy, engine, found, rows, moved[None] * (1 - weights.structures)[:, None])
    checked = anatomy.checked
    verdict = first_broken(paths, clearances, checked, needle=needle, max_skin_angle=case.search.max_skin_angle)
    demanding = np.array([one.demands_margin for one in checked], bool)
    margins = np.array([one.margin_mm for one in checked])[demanding]
    least = clearances.clearance[:, demanding].min(axis=1, initial=np.inf)
    excess = (clearances.clearance[:, demanding] - margins).min(axis=1, initial=np.inf)
    if bound is not None:
        verdict = bent_verdict(verdict, checked, clearances.clearance, bound.at(paths.path_length))
    near = (verdict.reason == Reason.NEEDLE_BENDS.value) | clearances.violated.any(axis=1)
    beyond = (verdict.reason != Reason.NONE.value) & ~near
    return _Phase(verdict, least, np.where(beyond, -np.inf, excess))


def paths_at(case: Case, skin: Skin, outward_ct: Floats, weight: float, moved_ct: Floats) -> SkinPaths:
    """The skin along paths to a target that the breath has moved; entries in the moved skin's own coordinates.

    What lies beyond the image moves by nobody knows how much: paths end at the nearest of the places that its border
    has if it stays, follows the skin, or follows the target.

    Args:
        case: Needle, limits, and the target where the CT shows it.
        skin: The skin, where the CT shows it.
        outward_ct: Shape (m, 3), unit.
        weight: Of the skin.
        moved_ct: Shape (3,), how far the target has moved, mm.
    """
    needle, target = case.needle, case.target_ct
    farthest = farthest_flange(needle, case.search.max_skin_angle)
    if not np.any(moved_ct):
        return skin_paths(skin, target, outward_ct, needle.length_mm, farthest)
    origins = [target + (1 - w) * moved_ct for w in (weight, 0.0, 1.0)]
    try:
        paths = skin_paths(skin, origins[0], outward_ct, needle.length_mm, farthest)
        views = np.array([view_depth(skin, origin, outward_ct) for origin in origins])
    except InputError:  # the breath takes the target out of the image: nothing is known around it
        return _unknown(len(outward_ct))
    view = np.fmin.reduce(views, axis=0)
    reached = np.where(view < needle.length_mm, view, np.nan)
    return replace(paths, view_depth=view, unknown_depth=np.fmin(paths.unknown_depth, reached))


def _unknown(count: int) -> SkinPaths:
    """Paths of which nothing is known from the target on."""
    blank, zero = np.full(count, np.nan), np.zeros(count)
    return SkinPaths(np.full((count, 3), np.nan), blank, blank, blank, zero, zero)


def _clearances(
    case: Case, anatomy: Anatomy, engine: ClearanceEngine, found: Candidates, rows: Ints, shifts_ct: Floats
) -> Clearances:
    """To all k structures with the target shifted for each, ``shifts_ct`` of shape (k, 3), mm."""
    checked, lengths = anatomy.checked, axis_lengths(case, anatomy.checked)
    clearance = found.clearance.distance[rows].copy()
    depth, violated = np.zeros(clearance.shape), np.zeros(clearance.shape, bool)
    demanding = np.array([one.demands_margin for one in checked], bool)
    for shift in np.unique(shifts_ct, axis=0):
        columns = np.flatnonzero((shifts_ct == shift).all(axis=1) & demanding)
        if not np.any(shift) or not len(columns):
            continue
        structures = tuple(checked[column] for column in columns)
        at = measure(
            engine.of(columns), structures, case.target_ct + shift, found.outward_ct[rows],
            length=lengths[columns], radius=case.needle.radius_mm,
        )  # fmt: skip
        clearance[:, columns], depth[:, columns], violated[:, columns] = at.clearance, at.depth, at.violated
    return Clearances(clearance, depth, violated)
