"""Skin and organs at every phase of the breath, if the needle is inserted at that phase.

At the position s the target is at t + s b d, and a structure of weight w is displaced by s w b d. Seen from the
structure, the needle starts at t + s b (1 - w) d: the surfaces stay where they are, and the engine prepared for them is
asked for another target. What moves with the target (w = 1) is not measured again.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.skin_entry import SkinPaths
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.reasons import REASON_TEXT, Reason
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.clearance.engine import ClearanceEngine
from puncture_twin.planning.clearance.measure import Clearances, measure
from puncture_twin.planning.needle.deflection import DeflectionBound
from puncture_twin.planning.reach.standoff import axis_lengths, own_paths
from puncture_twin.planning.search.bending.bent_needle import bent_verdict
from puncture_twin.planning.search.candidates import Candidates, Verdict
from puncture_twin.planning.search.constraints import first_broken
from puncture_twin.planning.search.phases.moving_weights import MovingWeights


@dataclass(frozen=True, eq=False)
class Phase:
    """What some candidates are at one position of the breath.

    Attributes:
        s: The position.
        rows: Shape (m,), which candidates.
        verdict: Of these m.
        clearance: Shape (m, k), to the k structures with a margin, mm.
        excess: Shape (m, k), the same less the margins.
        deflection: Shape (m,), how far the needle may bend, mm; 0 where it does not.
    """

    s: float
    rows: Ints
    verdict: Verdict
    clearance: Floats
    excess: Floats
    deflection: Floats

    @property
    def safe(self) -> Bools:
        """Shape (m,)."""
        return np.asarray(self.verdict.reason == Reason.NONE.value)

    @property
    def least_excess(self) -> Floats:
        """Shape (m,), mm; minus infinity where something else than a clearance rejects."""
        near = np.isin(self.verdict.reason, CLEARANCES) | self.safe
        return np.asarray(np.where(near, self.excess.min(axis=1, initial=np.inf), -np.inf))

    def of(self, which: Bools) -> Phase:
        """Of some of the candidates; ``which`` of shape (m,)."""
        rows = np.flatnonzero(which)
        arrays = (self.clearance[rows], self.excess[rows], self.deflection[rows])
        return Phase(self.s, self.rows[rows], self.verdict.of(rows), *arrays)


CLEARANCES = (Reason.TOO_CLOSE.value, Reason.UNKNOWN_REGION.value, Reason.NEEDLE_BENDS.value)
"""Reasons whose number is a clearance, the only one that is told of a phase."""


@dataclass(frozen=True, eq=False)
class BreathingBody:
    """A case that breathes, ready to be asked for any position.

    Attributes:
        case: The case.
        breathing: Of the case.
        anatomy: Its structures.
        engine: Prepared for the meshes of ``anatomy.checked``, in that order.
        weights: Of skin and structures.
        bound: How far the needle may bend; None bends nothing.
        found: The candidates, checked where the CT shows the body.
    """

    case: Case
    breathing: Breathing
    anatomy: Anatomy
    engine: ClearanceEngine
    weights: MovingWeights
    bound: DeflectionBound | None
    found: Candidates

    @cached_property
    def lengths(self) -> Floats:
        """How far the axes of the n candidates are checked against the k structures, shape (n, k), mm.

        Up to the farthest place at which the flange waits at any position.
        """
        case, checked, outward = self.case, self.anatomy.checked, self.found.outward_ct
        at = [axis_lengths(case, checked, self.paths(outward, s)) for s in self.breathing.positions.tolist()]
        return np.asarray(np.max(at, axis=0))

    def paths(self, outward_ct: Floats, s: float) -> SkinPaths:
        """The skin along paths (n, 3) at a position; entries in the moved skin's own coordinates."""
        moved = (1 - self.weights.skin) * self.breathing.moved_ct(s)
        return own_paths(self.case, self.anatomy.skin, outward_ct, moved)

    @property
    def demanding(self) -> Ints:
        """Columns of the structures with a margin."""
        return np.flatnonzero([one.demands_margin for one in self.anatomy.checked])

    @property
    def margins(self) -> Floats:
        """Of these, shape (k,), mm."""
        return np.array([self.anatomy.checked[column].margin_mm for column in self.demanding], dtype=np.float64)

    def moves_mm(self, low: float, high: float) -> Floats:
        """How far each structure with a margin moves against the target between two positions, shape (k,)."""
        weights = self.weights.structures[self.demanding]
        return np.asarray(abs(high - low) * self.breathing.amplitude_mm * np.abs(1 - weights))

    def at(self, rows: Ints, s: float) -> Phase:
        """Some candidates, ``rows`` (m,), at a position, as if inserted there."""
        case, checked, outward = self.case, self.anatomy.checked, self.found.outward_ct[rows]
        moved = self.breathing.moved_ct(s)
        paths = self.paths(outward, s)
        shifts = moved[None] * (1 - self.weights.structures)[:, None]
        clearances = self._clearances(rows, shifts)
        limit = case.search.max_skin_angle
        verdict = first_broken(paths, clearances, checked, needle=case.needle, max_skin_angle=limit)
        deflection = np.zeros(len(rows)) if self.bound is None else self.bound.at(paths.path_length)
        if self.bound is not None:
            verdict = bent_verdict(verdict, checked, clearances.clearance, deflection)
        clearance = clearances.clearance[:, self.demanding]
        return Phase(s, rows, verdict, clearance, clearance - self.margins, deflection)

    def excess_at(self, rows: Ints, s: float, columns: Ints) -> Floats:
        """What the surfaces of some structures leave over their margins at a position, shape (m, c), mm.

        Args:
            rows: Shape (m,), which candidates.
            s: The position.
            columns: Shape (c,), which of the structures with a margin.
        """
        case, which = self.case, self.demanding[columns]
        distance, weights = np.empty((len(rows), len(columns))), self.weights.structures[which]
        for weight in np.unique(weights):
            group = np.flatnonzero(weights == weight)
            origin = case.target_ct + (1 - weight) * self.breathing.moved_ct(s)
            part, length = self.engine.of(which[group]), self.lengths[np.ix_(rows, which[group])]
            distance[:, group] = part.measure(origin, self.found.outward_ct[rows], length, shown=False).distance
        return np.asarray(distance - case.needle.radius_mm - self.margins[columns])

    def _clearances(self, rows: Ints, shifts_ct: Floats) -> Clearances:
        """To all k structures with the target shifted for each, ``shifts_ct`` of shape (k, 3), mm."""
        checked, found, radius = self.anatomy.checked, self.found, self.case.needle.radius_mm
        clearance = found.clearance.distance[rows].copy()
        depth, violated = np.zeros(clearance.shape), np.zeros(clearance.shape, bool)
        moved = [one.demands_margin and (one.outside or by.any()) for one, by in zip(checked, shifts_ct, strict=True)]
        for shift in np.unique(shifts_ct[moved], axis=0):
            columns = np.flatnonzero((shifts_ct == shift).all(axis=1) & moved)
            structures, length = tuple(checked[column] for column in columns), self.lengths[np.ix_(rows, columns)]
            target, outward, part = self.case.target_ct + shift, found.outward_ct[rows], self.engine.of(columns)
            at = measure(part, structures, target, outward, length=length, radius=radius)
            clearance[:, columns], depth[:, columns], violated[:, columns] = at.clearance, at.depth, at.violated
        return Clearances(clearance, depth, violated)


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
