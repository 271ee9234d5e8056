"""Skin and organs at all positions of the breath, and between them; what the gate lets through decides the verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.clearance.engine import ClearanceEngine
from puncture_twin.planning.needle.deflection import DeflectionBound
from puncture_twin.planning.search.candidates import BreathingColumns, Candidates
from puncture_twin.planning.search.phases.between import checked_between
from puncture_twin.planning.search.phases.moving_weights import moving_weights
from puncture_twin.planning.search.phases.one_phase import BreathingBody, rejected_at


def with_breathing(
    case: Case, anatomy: Anatomy, engine: ClearanceEngine, found: Candidates, bound: DeflectionBound | None = None
) -> Candidates:
    """Check what is safe through the whole breath, and reject what is not while the gate lets the needle through.

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
    body = BreathingBody(case, breathing, anatomy, engine, moving_weights(case, breathing, anatomy), bound)
    rows, within = np.flatnonzero(found.safe), int(breathing.in_window.sum())
    phases = [body.at(found, rows, s) for s in breathing.positions.tolist()]
    verdict = through = found.verdict
    for at, phase in enumerate(phases):
        through = rejected_at(through, rows, phase.verdict, breathing, phase.s)
        if at:
            through = checked_between(body, found, through, phases[at - 1], phase)
        verdict = through if at < within else verdict  # the gate's window is the first of them
    blank = np.full(len(found), np.nan)
    worst, clearance = blank.copy(), blank.copy()
    excess = np.array([phase.least_excess for phase in phases[:within]])
    worst[rows] = breathing.positions[excess.argmin(axis=0)]
    clearance[rows] = np.min([phase.clearance.min(axis=1, initial=np.inf) for phase in phases[:within]], axis=0)
    safe_all = np.asarray(through.reason == Reason.NONE.value) & breathing.whole
    columns = BreathingColumns(safe_all, worst, clearance, breathing.window_text)
    return replace(found, verdict=verdict, breathing=columns)
