"""Breathing in the search: skin, organs and arm at every checked position of the breath, and clearance between them.

At the position s (0 exhale, 1 inhale) the target is at t + s b d, and a structure of weight w is displaced by s w b d
(amplitude b, unit direction d). Seen from the structure, the needle starts at t + s b (1 - w) d: so the surfaces stay
where they are, and the engine measures from another target. What moves with the target (w = 1) is not measured again.
Positions in the gate's window decide the verdict.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.skin import SkinPaths
from puncture_twin.planning.anatomy.unseen import BEYOND_IMAGE
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.reasons import REASON_TEXT, Reason
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.breathing.breathing import Breathing, fraction_within
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.clearance.engine import ClearanceEngine, MeasuredClearances, measure_clearances
from puncture_twin.planning.collision.workcell import GANTRY, OF_CASE_FILE, case_checker
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.needle.deflection import DeflectionBound
from puncture_twin.planning.reach.standoff import axis_lengths, case_paths
from puncture_twin.planning.search.bending import bent_verdict
from puncture_twin.planning.search.candidates import ArmColumns, BreathingColumns, Candidates, Verdict
from puncture_twin.planning.search.constraints import ArmReach, first_broken, with_reach


def with_breathing(
    case: Case,
    breathing: Breathing,
    anatomy: Anatomy,
    engine: ClearanceEngine,
    candidates: Candidates,
    bound: DeflectionBound | None,
) -> Candidates:
    """Check safe candidates at every position of the breath, and reject those that are unsafe in the gate's window."""
    body = BreathingBody(case, breathing, anatomy, engine, moving_weights(case, breathing, anatomy), bound, candidates)
    rows, within = np.flatnonzero(candidates.safe), int(breathing.in_window.sum())
    phases = [body.at(rows, s) for s in breathing.positions.tolist()]
    verdict = through = candidates.verdict
    for at, phase in enumerate(phases):
        through = rejected_at(through, rows, phase.verdict, breathing, phase.s)
        if at:
            before, columns = phases[at - 1], np.arange(len(body.demanding))
            deflection = np.fmax(before.deflection, phase.deflection)
            gap = _Gap(rows, columns, before.s, phase.s, before.excess, phase.excess, deflection)
            through = checked_between(body, through, gap)
        verdict = through if at < within else verdict  # the gate's window is the first of them
    worst, clearance = np.full((2, len(candidates)), np.nan)
    excess = np.array([phase.least_excess for phase in phases[:within]])
    worst[rows] = breathing.positions[excess.argmin(axis=0)]
    clearance[rows] = np.min([phase.clearance.min(axis=1, initial=np.inf) for phase in phases[:within]], axis=0)
    safe_all = through.safe & breathing.whole
    breath = BreathingColumns(safe_all, worst, clearance, breathing.window_text)
    return replace(candidates, verdict=verdict, breathing=breath)


def with_breathing_reach(
    case: Case, breathing: Breathing, anatomy: Anatomy, candidates: Candidates, reach: ArmReach
) -> Candidates:
    """Reject candidates that the arm cannot reach, or insert along, at a phase in the gate's window.

    The arm has been checked where the CT shows the body.
    """
    weights = moving_weights(case, breathing, anatomy)
    for s in breathing.positions[breathing.in_window].tolist():
        rows, shift_ct = np.flatnonzero(candidates.safe), breathing.moved_ct(s)
        if not (shift_ct.any() and len(rows)):
            continue
        there = _arm_at(case, breathing, anatomy, weights, s, reach.T_base_ct)
        paths = case_paths(case, anatomy.skin, candidates.outward_ct, (1 - weights.skin) * shift_ct)
        path = replace(candidates.path, length=paths.path_length, skin_angle=paths.skin_angle)
        shifted = replace(candidates, path=path, arm=ArmColumns.unknown(len(candidates)))
        at_phase = with_reach(replace(case, target_ct=case.target_ct + shift_ct), shifted, there).verdict.of(rows)
        candidates = replace(candidates, verdict=rejected_at(candidates.verdict, rows, at_phase, breathing, s))
    return candidates


def _arm_at(
    case: Case, breathing: Breathing, anatomy: Anatomy, weights: MovingWeights, s: float, T_base_ct: Floats
) -> ArmReach:
    """The arm among skin, surroundings, obstacles and gantry as they are at a position of the breath."""
    names = [one.name for one in anatomy.checked]
    by_ct = {
        name: breathing.moved_ct(s, weight) for name, weight in zip(names, weights.structures.tolist(), strict=True)
    }
    R, by_skin = {"ct": np.eye(3), "base": T_base_ct[:3, :3]}, breathing.moved_ct(s, weights.skin)

    def displaced_mesh(mesh: TriangleMesh, by: Floats) -> TriangleMesh:
        return mesh.transformed(pose(np.eye(3), by)) if by.any() else mesh

    skin = replace(anatomy.skin, mesh=displaced_mesh(anatomy.skin.mesh, by_skin))
    around = tuple(replace(one, mesh=displaced_mesh(one.mesh, by_ct[one.name])) for one in anatomy.surroundings)
    obstacles = [replace(one, center_mm=one.center_mm + R[one.frame] @ by_ct[one.name]) for one in case.obstacles]
    gantry = case.gantry
    if gantry is not None:
        gantry = replace(gantry, T_ct_gantry=pose(np.eye(3), by_ct[GANTRY]) @ gantry.T_ct_gantry)
    displaced = replace(case, obstacles=tuple(obstacles), gantry=gantry)
    checker = case_checker(displaced, replace(anatomy, skin=skin, surroundings=around), T_base_ct)
    return ArmReach(lambda: checker, T_base_ct)


@dataclass(frozen=True, eq=False)
class BreathingBody:
    """A case that breathes, measured at any position of the breath."""

    case: Case
    breathing: Breathing
    anatomy: Anatomy
    engine: ClearanceEngine
    weights: MovingWeights
    bound: DeflectionBound | None
    candidates: Candidates

    @cached_property
    def lengths(self) -> Floats:
        """Lengths to which the n axes are checked against the k structures, shape (n, k), mm.

        Up to the farthest place at which the flange waits at any position.
        """
        case, checked, outward = self.case, self.anatomy.checked, self.candidates.outward_ct
        paths = [self.paths(outward, s) for s in self.breathing.positions.tolist()]
        at = [axis_lengths(case, checked, one.path_length, one.skin_angle) for one in paths]
        return np.asarray(np.max(at, axis=0))

    def paths(self, outward_ct: Floats, s: float) -> SkinPaths:
        """Skin paths (n, 3) at a position; entries in the coordinates of the displaced skin."""
        shift_ct = (1 - self.weights.skin) * self.breathing.moved_ct(s)
        return case_paths(self.case, self.anatomy.skin, outward_ct, shift_ct)

    @property
    def demanding(self) -> Ints:
        """Columns of the structures with a margin."""
        return np.flatnonzero([one.demands_margin for one in self.anatomy.checked])

    @property
    def margins(self) -> Floats:
        """Margins of the structures with one, shape (k,), mm."""
        return np.array([self.anatomy.checked[column].margin_mm for column in self.demanding], dtype=np.float64)

    def at(self, rows: Ints, s: float) -> Phase:
        """The phase of candidates ``rows`` (m,) at a position, as if inserted there."""
        case, checked, outward = self.case, self.anatomy.checked, self.candidates.outward_ct[rows]
        paths = self.paths(outward, s)
        shifts = self.breathing.moved_ct(s)[None] * (1 - self.weights.structures)[:, None]
        clearances = self._clearances(rows, shifts)
        limit = case.search.max_skin_angle
        verdict = first_broken(paths, clearances, checked, needle=case.needle, max_skin_angle=limit)
        deflection = np.zeros(len(rows)) if self.bound is None else self.bound.at(paths.path_length)
        if self.bound is not None:
            verdict = bent_verdict(verdict, checked, clearances.clearance, deflection)
        clearance = clearances.clearance[:, self.demanding]
        return Phase(s, verdict, clearance, clearance - self.margins, deflection)

    def excess_at(self, rows: Ints, s: float, columns: Ints) -> Floats:
        """Clearance of candidates ``rows`` (m,) beyond the margins of some demanding structures (c,): (m, c), mm."""
        case, which = self.case, self.demanding[columns]
        distance, weights = np.empty((len(rows), len(columns))), self.weights.structures[which]
        for weight in np.unique(weights):
            group = np.flatnonzero(weights == weight)
            origin = case.target_ct + (1 - weight) * self.breathing.moved_ct(s)
            part, length = self.engine.of(which[group]), self.lengths[np.ix_(rows, which[group])]
            distance[:, group] = part.measure(origin, self.candidates.outward_ct[rows], length, shown=False).distance
        return np.asarray(distance - case.needle.radius_mm - self.margins[columns])

    def _clearances(self, rows: Ints, shifts_ct: Floats) -> MeasuredClearances:
        """Clearances to all k structures with the target shifted for each, ``shifts_ct`` of shape (k, 3), mm."""
        checked, candidates, radius = self.anatomy.checked, self.candidates, self.case.needle.radius_mm
        clearance = candidates.clearance.by_structure[rows].copy()
        depth, violated = np.zeros(clearance.shape), np.zeros(clearance.shape, bool)
        moving = [one.demands_margin and (one.outside or by.any()) for one, by in zip(checked, shifts_ct, strict=True)]
        for shift in np.unique(shifts_ct[moving], axis=0):
            columns = np.flatnonzero((shifts_ct == shift).all(axis=1) & moving)
            structures, length = tuple(checked[column] for column in columns), self.lengths[np.ix_(rows, columns)]
            target, outward, part = self.case.target_ct + shift, candidates.outward_ct[rows], self.engine.of(columns)
            at = measure_clearances(part, structures, target, outward, length=length, radius=radius)
            clearance[:, columns], depth[:, columns], violated[:, columns] = at.clearance, at.depth, at.violated
        return MeasuredClearances(clearance, depth, violated)


@dataclass(frozen=True, eq=False)
class Phase:
    """Verdict and clearances of some candidates at one position of the breath."""

    s: float
    verdict: Verdict
    clearance: Floats  # shape (m, k), to the k structures with a margin, mm
    excess: Floats  # shape (m, k), the same less the margins
    deflection: Floats  # shape (m,), how far the needle may bend, mm; 0 where it does not

    @property
    def least_excess(self) -> Floats:
        """Least clearance beyond a margin, shape (m,), mm; minus infinity where another reason rejects."""
        near = np.isin(self.verdict.reason, CLEARANCES) | self.verdict.safe
        return np.asarray(np.where(near, self.excess.min(axis=1, initial=np.inf), -np.inf))


CLEARANCES = (Reason.TOO_CLOSE.value, Reason.UNKNOWN_REGION.value, Reason.NEEDLE_BENDS.value)
"""Reasons whose number is a clearance, the only one that is reported of a phase."""


def rejected_at(verdict: Verdict, rows: Ints, at_phase: Verdict, breathing: Breathing, s: float) -> Verdict:
    """A verdict with candidates rejected, of ``rows`` (m,), that are unsafe at one phase; others keep their reason."""
    new = ~at_phase.safe & verdict.of(rows).safe
    at_phase = at_phase.of(np.flatnonzero(new))
    reasons = zip(at_phase.reason, at_phase.detail, strict=True)
    when = f"at {breathing.phase_text(s)}"
    details = [f"{when}: {REASON_TEXT[Reason(reason)]}{more and f', {more}'}" for reason, more in reasons]
    return verdict.with_rows(
        rows[new],
        reason=Reason.UNSAFE_WHEN_BREATHING.value,
        structure=at_phase.structure,
        depth=at_phase.depth,
        amount=np.where(np.isin(at_phase.reason, CLEARANCES), at_phase.amount, np.nan),
        detail=np.array(details, dtype=object),
    )


class _Gap(NamedTuple):
    """The interval between two positions: m candidates, k structures, excess over the margins (m, k), mm, at both."""

    rows: Ints
    columns: Ints
    low: float
    high: float
    at_low: Floats
    at_high: Floats
    deflection: Floats

    def of(self, rows: Bools, columns: Bools) -> _Gap:
        """The interval for some candidates and structures."""
        part = np.ix_(rows, columns)
        ends = self.at_low[part], self.at_high[part]
        return _Gap(self.rows[rows], self.columns[columns], self.low, self.high, *ends, self.deflection[rows])


LEAST_MM = 0.1
"""mm of motion below which an interval is not divided: what is not shown to be clear counts as too close."""


def checked_between(body: BreathingBody, verdict: Verdict, gap: _Gap) -> Verdict:
    """The verdict with candidates rejected that are not proven clear between two positions.

    A structure moves by m between them, so a clearance changes by m at most: its least in between is at least
    (low + high - m) / 2. Where that does not suffice, the interval is halved and measured in the middle.
    """
    weights = body.weights.structures[body.demanding[gap.columns]]
    moves = abs(gap.high - gap.low) * body.breathing.amplitude_mm * np.abs(1 - weights)
    least = (gap.at_low + gap.at_high - moves) / 2 - gap.deflection[:, None]  # no clearance falls faster than it moves
    short = (least < 0) & (moves > 0) & verdict.of(gap.rows).safe[:, None]
    rows, columns = np.asarray(short.any(axis=1)), np.asarray(short.any(axis=0))
    if not rows.any():
        return verdict
    gap, least, middle = gap.of(rows, columns), least[np.ix_(rows, columns)], (gap.low + gap.high) / 2
    if moves[columns].max() <= LEAST_MM:
        close = _too_close(body, gap, least, np.full(len(least), np.nan))
        return rejected_at(verdict, gap.rows, close, body.breathing, middle)
    excess = body.excess_at(gap.rows, middle, gap.columns)
    left = excess - gap.deflection[:, None]
    bad = left.min(axis=1) < 0
    column = left[bad].argmin(axis=1)
    amount = excess[bad][np.arange(len(column)), column] + body.margins[gap.columns[column]]
    close = _too_close(body, gap, left[bad], amount)
    verdict = rejected_at(verdict, gap.rows[bad], close, body.breathing, middle)
    verdict = checked_between(body, verdict, gap._replace(high=middle, at_high=excess))
    return checked_between(body, verdict, gap._replace(low=middle, at_low=excess))


def _too_close(body: BreathingBody, gap: _Gap, left: Floats, amount: Floats) -> Verdict:
    """Verdict of m candidates that come too close to the structure of their least excess, of ``left`` (m, k)."""
    names = np.array([body.anatomy.checked[column].name for column in body.demanding], dtype=object)
    blank, reason = np.full(len(left), "", dtype=object), np.full(len(left), Reason.TOO_CLOSE.value, dtype=object)
    return Verdict(reason, names[gap.columns[left.argmin(axis=1)]], np.full(len(left), np.nan), amount, blank)


class MovingWeights(NamedTuple):
    """Weights of the skin, and of the k checked structures, shape (k,)."""

    skin: float
    structures: Floats


def moving_weights(case: Case, breathing: Breathing, anatomy: Anatomy) -> MovingWeights:
    """The weight of every structure of a case that breathes: how much of the target's motion it follows.

    The target's own structure moves with the target, and obstacles and the gantry, which the case file describes, not
    at all.

    Raises:
        InputError: A structure without a weight, a pattern that matches none, or another weight for the target's own.
    """
    skin = case.skin_section.name
    stated = breathing.weights.of_pattern
    fixed = {one.name: 0.0 if one.source == OF_CASE_FILE else None for one in anatomy.checked}
    fixed |= dict.fromkeys(
        fixed.keys() & {case.target_structure, BEYOND_IMAGE}, 1.0
    )  # the breath has widened the latter
    needed = [skin, *(name for name, weight in fixed.items() if weight is None)]
    others = [name for name in fixed if name not in needed]
    breathing.weights.check(needed, "breathing.weights", case.path, others=others)
    own = stated.get(case.target_structure, 1.0)
    if own != 1.0:
        message = f"breathing.weights: '{case.target_structure}' contains the target, so its weight cannot be {own:g}"
        refuse(message, case.path, "1, or no weight: the amplitude is that of the target", "breathing_weight")
    of = breathing.weights.of
    weights = [of(name) if weight is None else stated.get(name, weight) for name, weight in fixed.items()]
    return MovingWeights(float(of(skin) or 0.0), np.array(weights, dtype=np.float64))


def breath_warnings(case: Case, anatomy: Anatomy) -> tuple[str, ...]:
    """Warnings on the meaning of a breathing case's verdicts; none where it declares no breathing."""
    breathing = case.breathing
    if breathing is None:
        return ()
    moving_weights(case, breathing, anatomy)
    gate, s = breathing.gate, breathing.scanned_at
    count = plural(int(breathing.in_window.sum()), "position")
    warnings = [
        f"breathing: a safe direction is safe {breathing.window_text}; checked at {count}, with clearances between "
        "them; an inserted needle moves with the organ and bends"
    ]
    if gate is not None:
        part = fraction_within(gate, breathing.exponent)
        warnings.append(f"breathing: the gate is open {part:.0%} of the time, if the breathing follows the curve")
    where = f"to the target where the CT shows it (s = {s:g}), with the patient at rest there"
    warnings.append(f"breathing: plans and rehearsals go {where}")
    if gate is not None and s > gate:
        warnings.append(f"breathing: the CT shows the body at s = {s:g}, outside the gate (s <= {gate:g})")
    return tuple(warnings)
