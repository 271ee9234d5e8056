"""Skin and organs at all positions of the breath, and between them; what the gate lets through decides the verdict."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.arrays import Bools, Floats, Ints, Texts
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.clearance.engine import ClearanceEngine
from puncture_twin.planning.needle.deflection import DeflectionBound
from puncture_twin.planning.search.candidates import BreathingColumns, Candidates, Verdict
from puncture_twin.planning.search.phases.moving_weights import moving_weights
from puncture_twin.planning.search.phases.one_phase import BreathingBody, Phase, rejected_at

LEAST_MM = 0.1
"""Positions this near to each other are not parted: what is not shown to be clear there counts as too close."""


class _Gap(NamedTuple):
    """Between the positions low and high: m candidates, k structures, what both leave over the margins, (m, k), mm."""

    rows: Ints
    columns: Ints
    low: float
    high: float
    at_low: Floats
    at_high: Floats
    deflection: Floats

    def of(self, rows: Bools, columns: Bools) -> _Gap:
        """Of some candidates and structures."""
        part = np.ix_(rows, columns)
        ends = self.at_low[part], self.at_high[part]
        return _Gap(self.rows[rows], self.columns[columns], self.low, self.high, *ends, self.deflection[rows])


def checked_between(body: BreathingBody, verdict: Verdict, low: Phase, high: Phase) -> Verdict:
    """The verdict with those rejected that no measurement shows to be clear between two positions.

    Args:
        body: The case.
        verdict: Of the candidates, with what is rejected at the two positions.
        low: The one position.
        high: The other, of the same candidates.
    """
    deflection = np.fmax(low.deflection, high.deflection)
    columns = np.arange(len(body.demanding))
    return _checked(body, verdict, _Gap(low.rows, columns, low.s, high.s, low.excess, high.excess, deflection))


def _checked(body: BreathingBody, verdict: Verdict, gap: _Gap) -> Verdict:
    moves = body.moves_mm(gap.low, gap.high)[gap.columns]
    least = (gap.at_low + gap.at_high - moves) / 2 - gap.deflection[:, None]
    short = (least < 0) & (moves > 0) & (verdict.reason[gap.rows] == Reason.NONE.value)[:, None]
    rows, columns = short.any(axis=1), short.any(axis=0)
    if not rows.any():
        return verdict
    gap, least, middle = gap.of(rows, columns), least[np.ix_(rows, columns)], (gap.low + gap.high) / 2
    if moves[columns].max() <= LEAST_MM:
        nearest = _names(body, gap, least)
        return rejected_at(
            verdict, gap.rows, _too_close(nearest, np.full(len(nearest), np.nan)), body.breathing, middle
        )
    excess = body.excess_at(gap.rows, middle, gap.columns)
    left = excess - gap.deflection[:, None]
    bad = left.min(axis=1) < 0
    column = left[bad].argmin(axis=1)
    amount = excess[bad][np.arange(len(column)), column] + body.margins[gap.columns[column]]
    close = _too_close(_names(body, gap, left)[bad], amount)
    verdict = rejected_at(verdict, gap.rows[bad], close, body.breathing, middle)
    verdict = _checked(body, verdict, gap._replace(high=middle, at_high=excess))
    return _checked(body, verdict, gap._replace(low=middle, at_low=excess))


def _names(body: BreathingBody, gap: _Gap, left: Floats) -> Texts:
    """The structure that leaves each candidate least."""
    names = np.array([body.anatomy.checked[column].name for column in body.demanding], dtype=object)
    return np.asarray(names[gap.columns[left.argmin(axis=1)]])


def _too_close(names: Texts, amount: Floats) -> Verdict:
    blank, reason = np.full(len(names), "", dtype=object), np.full(len(names), Reason.TOO_CLOSE.value, dtype=object)
    return Verdict(reason, names, np.full(len(names), np.nan), amount, blank)


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
    body = BreathingBody(case, breathing, anatomy, engine, moving_weights(case, breathing, anatomy), bound, found)
    rows, within = np.flatnonzero(found.safe), int(breathing.in_window.sum())
    phases = [body.at(rows, s) for s in breathing.positions.tolist()]
    verdict = through = found.verdict
    for at, phase in enumerate(phases):
        through = rejected_at(through, rows, phase.verdict, breathing, phase.s)
        if at:
            through = checked_between(body, through, phases[at - 1], phase)
        verdict = through if at < within else verdict  # the gate's window is the first of them
    blank = np.full(len(found), np.nan)
    worst, clearance = blank.copy(), blank.copy()
    excess = np.array([phase.least_excess for phase in phases[:within]])
    worst[rows] = breathing.positions[excess.argmin(axis=0)]
    clearance[rows] = np.min([phase.clearance.min(axis=1, initial=np.inf) for phase in phases[:within]], axis=0)
    safe_all = np.asarray(through.reason == Reason.NONE.value) & breathing.whole
    columns = BreathingColumns(safe_all, worst, clearance, breathing.window_text)
    return replace(found, verdict=verdict, breathing=columns)
