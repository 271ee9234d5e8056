"""What a command about a patient has done so far, and the files that it wrote, by their names."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import Severity, refuse
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.budget.guidance import check_way, stepped
from puncture_twin.planning.certify.certificate import Certificate
from puncture_twin.planning.clearance.fcl_engine import CrossChecked
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.search.bedside import EntryFacts
from puncture_twin.planning.search.candidates import Candidates, Pick
from puncture_twin.planning.search.constraints import closest_miss
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import needle_warnings, reason_text
from puncture_twin.planning.search.sides import sides_text
from puncture_twin.planning.search.windows import MOST_WINDOWS
from puncture_twin.twin.jobs.patient.summaries import (
    plan_summary,
    rehearsal_failures,
    rehearsal_summary,
    trial_failures,
    window_summary,
)
from puncture_twin.twin.report import patient
from puncture_twin.twin.report.numbers import TRUTH_IS_BELIEF
from puncture_twin.twin.report.present import Section, footer, text

if TYPE_CHECKING:
    from puncture_twin.twin.rehearsal.distribution import Distribution
    from puncture_twin.twin.rehearsal.result import Rehearsal


PAGE, SLICES = "report.html", "slices.png"
PICTURES = ("map.png", "scene.png", SLICES, PAGE)
"""What a search writes beside its table; slices only where there is a direction to show."""

FILM, ROOMS = "rehearsal.mp4", "rooms.png"


class RoomCount(NamedTuple):
    """How many rooms are rehearsed, how many in the simulator too, the way of guidance if any, and its steps."""

    rooms: int
    physics: int = 0
    guidance: str | None = None
    steps: int | None = None


def room_count(
    rooms: int | None, physics: int, guidance: str | None = None, steps: int | None = None
) -> RoomCount | None:
    """How many rooms are wanted; None for none beside the one that is executed.

    Raises:
        InputError: More in the simulator than there are, guidance that is unknown, or without trials, or steps of
            another than ct.
    """
    stepped(guidance, steps)
    if guidance is not None:
        check_way(guidance)
        if rooms is None or physics:
            what = "--guidance leads the needle in trials without physics"
            refuse(what, "--guidance", "--guidance WAY --seeds N, without --physics", "conflicting_options")
    if physics > (rooms or 0):
        refuse("--physics runs some of the trials", "--physics", "--seeds N --physics K, K <= N", "conflicting_options")
    return None if rooms is None else RoomCount(rooms, physics, guidance, steps)


@dataclass(frozen=True, eq=False)
class Run:
    """What a command has done so far, and the files that it wrote.

    Attributes:
        refusal: Why there is no plan although the command makes one; "" where it makes none.
    """

    context: CaseContext
    candidates: Candidates
    files: tuple[Path, ...]
    plan: Plan | None = None
    refusal: str = ""
    rehearsal: Rehearsal | None = None
    checked: CrossChecked | None = None
    certificate: Certificate | None = None
    read: tuple[Input, ...] = ()
    distribution: Distribution | None = None
    pick: Pick | None = None

    @property
    def inputs(self) -> tuple[Input, ...]:
        """The files that the command read beside the case's, then the case's."""
        return (*self.read, *self.context.case.inputs)

    @property
    def facts(self) -> EntryFacts | None:
        """The path of the plan, else of the best direction, for whoever stands at the patient; None without either."""
        if self.plan is not None:
            return self.context.entry_facts(self.plan.entry_ct, self.plan.outward_ct)
        pick = self.pick or self.candidates.best
        if pick is None:
            return None
        found, row = pick
        return self.context.entry_facts(found.path.entry_ct[row], found.outward_ct[row])

    @property
    def failures(self) -> tuple[str, ...]:
        """How the rehearsed needle missed or touched, and where more trials did than the case allows; "" for none."""
        if self.rehearsal is None:
            return ()
        of_many = () if self.distribution is None else trial_failures(self.context.case, self.distribution)
        return (*rehearsal_failures(self.context, self.rehearsal), *of_many)

    def with_files(self, *files: Path) -> Run:
        """The run with files more."""
        return replace(self, files=(*self.files, *files))

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm and degrees."""
        found, provenance = self.candidates, self.context.provenance()
        found_windows = found.windows
        windows, largest = found_windows.windows, found_windows.largest
        at_patient = {} if self.facts is None else self.facts.summary()
        return {
            **provenance,
            "warnings": [*provenance["warnings"], *needle_warnings(self.context.case, found)],
            "findings": [*provenance["findings"], *(one.document() for one in found.findings)],
            "inputs": inputs_document(self.inputs),
            "headline": found_windows.headline,
            "largest_window": None if largest is None else window_summary(found, largest),
            "looked": sides_text(self.context.sides, searched=True),
            "sides": [side.document() for side in self.context.sides],
            "directions": len(found),
            "counts": found.counts(),
            "best": [window_summary(found, window) for window in windows[:MOST_WINDOWS]],
            "windows": len(windows),
            "safe_cone_from": found.cone_source,
            "plan": None if self.plan is None else plan_summary(self.plan) | at_patient,
            "rehearsal": None if self.rehearsal is None else rehearsal_summary(self.rehearsal),
            **({} if self.rehearsal is None else {"failures": list(self.failures)}),
            **({} if self.distribution is None else {"distribution": self.distribution.summary()}),
            "cross_check": None if self.checked is None else asdict(self.checked),
            "certificate": None if self.certificate is None else self.certificate.summary(),
            "seconds": {stage: round(seconds, 3) for stage, seconds in self.context.stages.seconds.items()},
            "files": [str(path) for path in self.files],
        }

    @property
    def plan_notes(self) -> tuple[str, ...]:
        """What else must be known of the plan's expected error and of its aim."""
        if self.plan is None:
            return ()
        notes = [] if self.context.case.bending is None else ["The expected error assumes a straight needle."]
        if self.context.chance is None:
            notes.append("The expected error counts the markers alone: [errors] does not declare the arm's errors.")
        return (*notes, *_other_configuration(self.candidates, self.plan), *self._other_aim(self.plan))

    def _other_aim(self, plan: Plan) -> list[str]:
        """That the pose was corrected for another insertion, and what would correct it for this one."""
        registration = None if self.context.placement is None else self.context.placement.registration
        q = plan.insertion.q[-1]
        if registration is None or registration.aim is None or np.abs(q - registration.aim.q).max() < SAME_AIM:
            return []
        joints = ", ".join(f"{angle:.2f}" for angle in np.degrees(q))
        return [f"The aim is corrected for another insertion. For this one, set correct_joints_deg = [{joints}]."]

    def text(self) -> str:
        """What a person reads: what must be read first, the search, then what was done with it; then the files."""
        return text([*self._first(), *self._searched(), *self._done(), *self._footer()])

    def _first(self) -> list[Section]:
        belief = self.rehearsal is not None and self.rehearsal.truth_is_belief
        return [Section(f"NOTE: {TRUTH_IS_BELIEF}", [])] if belief else []

    def _searched(self) -> list[Section]:
        found, sides = self.candidates, self.context.sides
        looked = f", entry sides: {sides_text(sides, searched=True)}" if sides else ""
        warned = (*needle_warnings(self.context.case, found), *(one.sentence for one in found.findings))
        return [
            Section(f"case {self.context.case.name}: {found.windows.headline}", []),
            Section(f"{plural(len(found), 'direction')}{looked}", patient.counts(found)),
            *(Section(one, []) for one in warned),
            Section("the best of each window", patient.windows(found, self.context.anatomy.scan))
            if found.safe.any()
            else self._nothing_safe(),
        ]

    def _nothing_safe(self) -> Section:
        row = closest_miss(self.candidates)
        if row is None:
            return Section("no candidate is safe", [])
        at = self.candidates.at(row)
        angles = f"theta {at['theta_deg']:g} deg, beta {at['beta_deg']:g} deg"
        return Section(f"no candidate is safe; the closest, {angles}: {reason_text(self.candidates, row)}", [])

    def _done(self) -> list[Section]:
        """Plan, rehearsal, many rooms, certificate and cross-check, where there are any."""
        away = frozenset(one.name for one in self.context.anatomy.structures if one.demands_margin)
        at_patient = () if self.facts is None else self.facts.rows()
        declared = self.context.chance is not None
        done = []
        if self.plan is not None:
            done.append(Section("plan", patient.plan(self.plan, at_patient, declared=declared, notes=self.plan_notes)))
        if self.rehearsal is not None:
            done.append(Section("rehearsal", patient.rehearsal(self.rehearsal, away, failures=self.failures)))
        if self.distribution is not None:
            done.append(Section("many trials", patient.rooms(self.distribution.summary())))
        if self.certificate is not None:
            done.append(Section("certificate", patient.certificate(self.certificate.summary())))
        if (checked := self.checked) is not None:
            done.append(Section(
                f"cross-check: FCL measured {checked.directions} directions again; {checked.pairs} distances agree,"
                f" largest difference {checked.largest_mm:.1e} mm", []))  # fmt: skip
        return done

    def _footer(self) -> list[Section]:
        anatomy = self.context.anatomy
        notes = [Section(f"note: {one.sentence}", []) for one in anatomy.findings if one.severity is Severity.NOTE]
        ending = footer(self.files, anatomy.warnings, self.context.stages.seconds)
        return [*notes, *ending]


NOTABLE = 0.05
"""Of an expected error: by as much two configurations' differ before people are told."""

SAME_AIM = 0.02
"""rad: joints that differ by less are of one insertion; an arm's errors do the same there within a fiftieth."""


def _other_configuration(candidates: Candidates, plan: Plan) -> list[str]:
    """That the table's row of the plan's direction is of another configuration, where that tells."""
    row = np.flatnonzero((candidates.theta == plan.theta) & (candidates.beta == plan.beta))
    if candidates.chances is None or not len(row):
        return []
    other = float(np.hypot(candidates.chances.lateral_mm[row[0]], candidates.chances.depth_mm[row[0]]))
    if not abs(other - plan.expected_target_error_mm) > NOTABLE * plan.expected_target_error_mm:
        return []
    return [f"In the configuration of the table and of check: {other:.2f} mm. The approach may end in another."]
