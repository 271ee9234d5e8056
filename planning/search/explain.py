"""One candidate, explained in full: every constraint with its number and its limit."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy, surface_distance
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.base.text import Facts, Shown, brief
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.reach.standoff import standoffs
from puncture_twin.planning.search.bedside import EntryFacts
from puncture_twin.planning.search.bending import Insertion, Stretch, insertion_along, stretches
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.uncertainty_breakdown import UncertaintyBreakdown, chance_text, way_cells
from puncture_twin.planning.uncertainty.guided import WayChance

NEAREST = 8
"""Structures listed by default: a case has a hundred, and those far away decide nothing."""
COARSE_VOXEL_MM = 1.0
"""A surface drawn around voxels of this size is somewhere within half of it."""
NO_CHANCES = "no chances to hit and to touch: they need markers, the arm, and a direction safe for organs and arm"

UNITS = {
    Reason.SKIN_ANGLE.value: "deg",
    Reason.TOO_LONG.value: "mm of path",
    Reason.HIT_UNLIKELY.value: "chance to hit",
    Reason.TOUCH_LIKELY.value: "chance to touch",
}
"""Unit of the number that fell short, by reason; for all others it is a clearance in mm."""


@dataclass(frozen=True, eq=False)
class Explanation(Shown):
    """A checked candidate with what it was checked against."""

    case: Case
    anatomy: Anatomy
    candidates: Candidates
    """A search's result with this candidate alone."""
    facts: EntryFacts
    """The path as a person at the patient sees it."""
    breakdown: UncertaintyBreakdown | None = None
    """How sure it is; None where the case declares no errors, or the candidate was rejected before."""
    read: tuple[Input, ...] = ()
    """What was read besides the case to choose it."""
    guidance: tuple[WayChance, ...] = ()
    """What each way of guidance would leave; empty where the case declares no devices."""
    sight: Mapping[str, str] = field(default_factory=dict)
    """Of the declared ones, cameras and probe, what they see of the insertion, or why not, in words."""

    def _title(self) -> str:
        return self.head()[0]

    def _facts(self) -> Facts:
        for line in self.head()[1:]:
            yield "why", line.strip()
        yield "arm", self.candidates.arm_note
        if np.isfinite(length := self.candidates.path.length[0]):
            yield "path", f"{length:.1f} mm"
        yield from self.facts.rows()
        for name, clearance in sorted(self.clearances().items(), key=lambda one: one[1])[:NEAREST]:
            yield f"clearance to {name}", f"{clearance:.2f} mm"

    @brief
    def __repr__(self) -> str:
        return f"case {self.case.name}, {' '.join(line.strip() for line in self.head())}; .text() has all"

    @property
    def safe(self) -> bool:
        """Whether the candidate breaks no constraint."""
        return bool(self.candidates.safe[0])

    @property
    def verdict(self) -> str:
        """``safe`` or ``rejected``; for the organs alone where ``arm_note`` says that the arm was not checked."""
        return "safe" if self.safe else "rejected"

    @property
    def target_depth_mm(self) -> float:
        """Distance of the target from the surface of its own structure, mm."""
        return surface_distance(self.anatomy.structure(self.case.target_structure).mesh, self.case.target_ct)

    def clearances(self) -> dict[str, float]:
        """Structure to clearance, mm."""
        clearance = self.candidates.clearance
        return dict(zip(clearance.structures, map(float, clearance.by_structure[0]), strict=True))

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm and degrees; null where there is no number."""
        row = self.candidates
        return {
            "case": self.case.name,
            "inputs": inputs_document((*self.read, *self.case.inputs)),
            **row.at(0),
            "verdict": self.verdict,
            "arm": row.arm_note,
            "reason": str(row.verdict.reason[0]),
            "reason_structure": str(row.verdict.structure[0]),
            "reason_depth_mm": finite(row.verdict.depth[0]),
            "reason_amount": finite(row.verdict.amount[0]),
            "reason_detail": str(row.verdict.detail[0]),
            "entry_ct_mm": [finite(x) for x in row.path.entry_ct[0]],
            **self.facts.summary(),
            "target_depth_mm": self.target_depth_mm,
            "path_length_mm": finite(row.path.length[0]),
            "skin_angle_deg": finite(np.degrees(row.path.skin_angle[0])),
            "tissue_mm": finite(row.path.tissue[0]),
            "clearance_mm": self.clearances(),
            "reachable": None if row.arm.reachable[0] < 0 else bool(row.arm.reachable[0]),
            "reach_margin": finite(row.arm.margin[0]),
            "at_target": self._at_target(),
            "safe_cone_deg": finite(np.degrees(row.safe_cone[0])),
            "cost": finite(row.ranking.cost[0]),
            "along_path": [
                {
                    "start_mm": part.start_mm,
                    "end_mm": part.end_mm,
                    "structures": list(part.structures),
                    "hu": [finite(part.hu_low), finite(part.hu_median), finite(part.hu_high)],
                }
                for part in self.along_path
            ],
            "warnings": list(self.anatomy.warnings),
            "findings": [one.document() for one in self.anatomy.findings],
            **self._declared(),
        }

    def _declared(self) -> dict[str, Any]:
        """Parts of the summary of a case that declares errors, bending, breathing, guidance or lines of sight."""
        row, breathing, insertion = self.candidates, self.candidates.breathing, self.insertion
        optional: dict[str, Any] = {}
        if self.case.errors is not None:
            optional["chances"] = None if self.breakdown is None else self.breakdown.summary()
        if row.deflection is not None:
            optional["bending"] = {
                "deflection_bound_mm": finite(row.deflection[0]),
                "deflection_mm": None if insertion is None else insertion.tip_mm,
                "peak_force_n": None if insertion is None else insertion.force.peak_n,
                "buckling_free_n": None if insertion is None else insertion.buckling_free_n,
                "buckling_pinned_n": None if insertion is None else insertion.buckling_pinned_n,
            }
        if breathing is not None:
            optional["breathing"] = {
                "safe_all_phases": bool(breathing.safe_all_phases[0]),
                "worst_phase": finite(breathing.worst_phase[0]),
                "breathing_clearance_mm": finite(breathing.clearance[0]),
                "safe_means": row.safe_text,
            }
        if self.guidance:
            optional["guidance"] = [one.document() for one in self.guidance]
        if self.sight:
            optional["sight"] = dict(self.sight)
        return optional

    def _at_target(self) -> dict[str, list[float]] | None:
        """Joints and both ends of the needle with the tip at the target, as the robot's controller prints them."""
        q = self.candidates.arm.q_insertion[0]
        if not np.isfinite(q).all():
            return None
        T = flange_pose(self.case.robot.model, q)
        tip = T[:3, 3] + self.case.needle.length_mm * T[:3, 2]
        return {"q_deg": np.degrees(q).tolist(), "tip_base_mm": tip.tolist(), "flange_base_mm": T[:3, 3].tolist()}

    @cached_property
    def along_path(self) -> tuple[Stretch, ...]:
        """Hounsfield units and structures along the path; empty without a CT."""
        row = self.candidates
        return stretches(self.anatomy, self.case.target_ct, row.outward_ct[0], float(row.path.length[0]))

    def head(self) -> list[str]:
        """The direction, its verdict, and why."""
        row = self.candidates
        verdict = row.safe_text if self.safe else self.verdict
        head = f"theta {np.degrees(row.theta[0]):g} deg, beta {np.degrees(row.beta[0]):g} deg: {verdict}"
        return [head] if self.safe else [head, "  because " + reason_text(row, 0)]

    def text(self, most: int | None = NEAREST) -> str:
        """The whole explanation for a person."""
        lines = [f"case {self.case.name}", *self.head(), *self._uncertainty(), *self._path()]
        lines.append(
            f"  target         {self.target_depth_mm:8.2f} mm below the surface of {self.case.target_structure}"
        )
        if self.insertion is not None and self.candidates.deflection is not None:
            lines += self.insertion.lines(float(self.candidates.deflection[0]))
        lines += [*self._breath(), *self._scan(), *self.structure_lines(most), *(f"  {line}" for line in self._arm())]
        return "\n".join([*lines, *(f"  warning: {warning}" for warning in self.anatomy.warnings)])

    def _uncertainty(self) -> list[str]:
        lines = [] if self.case.errors is None else [NO_CHANCES]
        if self.breakdown is not None:
            lines = self.breakdown.lines()
            for way, mm, hit, stop, lost in map(way_cells, self.guidance):
                lines.append(f"by {way:10s} {mm} mm rms, hits {hit}, stopped {stop}{lost and ', not all in sight'}")
        return [f"  {line}" for line in (*lines, *(f"{device:14s} {said}" for device, said in self.sight.items()))]

    def _path(self) -> list[str]:
        row, needle = self.candidates, self.case.needle
        described = [f"  {label:18s} {value}" for label, value in self.facts.rows()]
        if np.isnan(row.path.length[0]):
            return ["  no skin entry on this path", *described]
        limit = np.degrees(self.case.search.max_skin_angle)
        standoff = float(standoffs(needle, row.path.length[0], row.path.skin_angle[0]))
        before, flange = standoff - row.path.length[0], standoff + needle.length_mm
        return [
            *described,
            f"  path length    {row.path.length[0]:8.2f} mm, allowed {needle.longest_path_mm:g}",
            f"  skin angle     {np.degrees(row.path.skin_angle[0]):8.2f} deg, allowed {limit:g}",
            f"  standoff       {standoff:8.2f} mm, its tip {before:.1f} mm before the skin, the flange at {flange:.1f}",
        ]

    @cached_property
    def insertion(self) -> Insertion | None:
        """Deflection and forces along the path; None without tissue, or without an entry."""
        row, bending = self.candidates, self.case.bending
        if bending is None or np.isnan(row.path.length[0]):
            return None
        return insertion_along(bending, self.anatomy, self.case.target_ct, row.outward_ct[0], float(row.path.length[0]))

    def _breath(self) -> list[str]:
        columns, breathing = self.candidates.breathing, self.case.breathing
        if columns is None or breathing is None or np.isnan(columns.clearance[0]):
            return []
        return [
            f"  breathing      {columns.clearance[0]:8.2f} mm least clearance, at "
            f"{breathing.phase_text(float(columns.worst_phase[0]))}",
            "                 an inserted needle moves with the organ and bends: the verdict does not cover that",
        ]

    def _scan(self) -> list[str]:
        if not self.along_path:
            return []
        lines = ["  along the path, mm from the target:   HU least, median, most   inside of"]
        for part in self.along_path:
            hu = f"{part.hu_low:8.0f} {part.hu_median:8.0f} {part.hu_high:8.0f}"
            lines.append(
                f"    {part.start_mm:6.0f} to {part.end_mm:4.0f} {hu:>41s}   {', '.join(part.structures) or '-'}"
            )
        return lines

    def structure_lines(self, most: int | None = NEAREST) -> list[str]:
        """Clearance and margin of each structure, the nearest first; beyond ``most`` only of those too near."""
        structures, clearances = self.anatomy.checked, self.candidates.clearance.by_structure[0]
        order = np.argsort(clearances, kind="stable")
        short = np.array([s.demands_margin and c < s.margin_mm for s, c in zip(structures, clearances, strict=True)])
        shown = [at for rank, at in enumerate(order) if most is None or rank < most or short[at]]
        lines = ["  structure                        role       clearance mm   margin mm"]
        for column in shown:
            one, mm = structures[column], clearances[column]
            margin = f"{one.margin_mm:11.2f}" if one.demands_margin else "          -"
            crossed = "enters" if one.role == Role.TARGET else "crossed"
            notes = ", ".join(note for note, holds in (("too close", short[column]), (crossed, mm < 0)) if holds)
            text = f"  {one.name:32s} {one.role:8s} {mm:14.{decimals(one)}f} {margin}"
            lines.append(f"{text}  {notes}" if notes else text)
        left = len(order) - len(shown)
        return [*lines, f"  and {left} more, farther away"] if left else lines

    def nearest_demanding(self) -> str:
        """The structure with the least clearance among those that demand a margin; "" without any."""
        clearance = self.candidates.clearance
        demanded = np.where(np.isnan(clearance.margins), np.inf, clearance.by_structure[0])
        return clearance.structures[int(np.argmin(demanded))] if np.isfinite(demanded).any() else ""

    def _arm(self) -> list[str]:
        row = self.candidates
        if not row.arm_checked:
            return [f"arm {row.arm_note}"]
        no_need = "not computed: the organs reject the direction"
        reached = {-1: no_need, 0: "no", 1: f"yes, margin {row.arm.margin[0]:.2f}"}
        lines = [f"arm reaches it: {reached[int(row.arm.reachable[0])]}"]
        if (there := self._at_target()) is not None:
            tip, flange = (", ".join(f"{mm:.1f}" for mm in there[f"{end}_base_mm"]) for end in ("tip", "flange"))
            lines.append(f"at the target      tip ({tip}), flange ({flange}) mm in the robot's base")
        return lines


def decimals(structure: Structure) -> int:
    """Decimals of a clearance in mm for people: a surface drawn around coarse voxels has no hundredths."""
    return 1 if structure.voxel_mm >= COARSE_VOXEL_MM else 2


def needle_warnings(case: Case, candidates: Candidates) -> list[str]:
    """Warnings where a longer needle would free more directions than this one does."""
    short = candidates.verdict.reason == Reason.TOO_LONG.value
    crossed = (candidates.clearance.by_structure < candidates.clearance.margins).any(axis=1)
    freed = short & ~crossed & (candidates.path.skin_angle <= case.search.max_skin_angle)
    if freed.sum() <= candidates.safe.sum():
        return []
    lengths = candidates.path.length[freed]
    return [
        f"the needle is too short for {short.sum()} of {len(candidates)} directions: its longest path is "
        f"{case.needle.longest_path_mm:g} mm. {freed.sum()} of them, of {lengths.min():.0f} to "
        f"{lengths.max():.0f} mm, are rejected for nothing else"
    ]


def reason_text(candidates: Candidates, row: int) -> str:
    """Reason, structure, depth and number of a rejected candidate, in one line."""
    parts = [str(candidates.verdict.reason[row])]
    if candidates.verdict.named[row]:
        parts.append(f"({candidates.verdict.named[row]})")
    if np.isfinite(candidates.verdict.depth[row]):
        parts.append(f"at {candidates.verdict.depth[row]:.1f} mm from the target")
    text, reason, amount = " ".join(parts), parts[0], float(candidates.verdict.amount[row])
    margin, clearance = np.nan, candidates.clearance
    if reason == Reason.TOO_CLOSE.value:
        margin = clearance.margins[clearance.structures.index(str(candidates.verdict.structure[row]))]
    if np.isfinite(amount) and reason not in UNITS and amount < 0:  # a negative clearance ends at minus the radius
        text += f": the needle crosses it{deep_text(amount)}"
        text += f"; {margin:g} mm clearance is demanded" if np.isfinite(margin) else ""
    elif np.isfinite(amount):
        unit = UNITS.get(reason, "mm clearance")
        text += f" with {chance_text(amount) if unit.startswith('chance') else f'{amount:.2f}'} {unit}"
        text += f" where {margin:g} mm is demanded" if np.isfinite(margin) else ""
    if candidates.verdict.detail[row]:
        text += f" - {candidates.verdict.detail[row]}"
    return text


def deep_text(clearance_mm: float) -> str:
    """Text of how deep a needle of negative clearance is at least in what it crosses, rounded down to 0.01 mm.

    >>> deep_text(-0.5951), deep_text(-0.6), deep_text(-1e-9)
    (', at least 0.59 mm deep', ', at least 0.6 mm deep', '')
    """
    deep_mm = math.floor(-100.0 * clearance_mm + 1e-9) / 100.0
    return f", at least {deep_mm:g} mm deep" if deep_mm > 0.0 else ""


def finite(value: float) -> float | None:
    """The number, or None where there is none (JSON knows no NaN)."""
    return float(value) if np.isfinite(value) else None
