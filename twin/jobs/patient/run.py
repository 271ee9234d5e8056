"""What a command about a patient has done so far, and the files that it wrote, by their names."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.certify.certificate import Certificate
from puncture_twin.planning.clearance.fcl_engine import CrossChecked
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.search.bedside import EntryFacts
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.choice import Pick, best_pick
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import needle_warnings
from puncture_twin.planning.search.sides import sides_text
from puncture_twin.planning.search.windows import MOST_WINDOWS, find_windows
from puncture_twin.twin.jobs.patient.summaries import (
    plan_summary,
    rehearsal_failures,
    rehearsal_summary,
    trial_failures,
    window_summary,
)

if TYPE_CHECKING:
    from puncture_twin.twin.rehearsal.distribution import Distribution
    from puncture_twin.twin.rehearsal.result import Rehearsal


PAGE, SLICES = "report.html", "slices.png"
PICTURES = ("map.png", "scene.png", SLICES, PAGE)
"""What a search writes beside its table; slices only where there is a direction to show."""

FILM, ROOMS = "rehearsal.mp4", "rooms.png"


class RoomCount(NamedTuple):
    """How many rooms are rehearsed, and how many of them in the simulator too."""

    rooms: int
    physics: int = 0


def room_count(rooms: int | None, physics: int) -> RoomCount | None:
    """How many rooms are wanted; None for none beside the one that is executed.

    Raises:
        InputError: More in the simulator than there are.
    """
    if physics > (rooms or 0):
        refuse("--physics runs some of the rooms", "--physics", "--seeds N --physics K, K <= N", "conflicting_options")
    return None if rooms is None else RoomCount(rooms, physics)


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
        pick = self.pick or best_pick(self.candidates)
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
        found_windows = find_windows(found)
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
