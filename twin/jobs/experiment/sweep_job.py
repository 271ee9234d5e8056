"""`rehearse --sweep`: the needle rotated about the target from outside, as far as the planner allows it."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.formats.csv_table import parse_coordinate
from puncture_twin.planning.search.choice import Choice, choose, chosen_angles
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.sweep.sweep_planner import SweepPlan, plan_sweep
from puncture_twin.twin.jobs.patient.main_job import is_plan
from puncture_twin.twin.jobs.terminal import write_result
from puncture_twin.twin.rehearsal.rehearsal import Swept, execute_sweep
from puncture_twin.twin.report.present import Section, footer, text

SWEEP = "sweep.json"
Angles = tuple[float, float]


@dataclass(frozen=True, eq=False)
class SweepRun:
    """A planned sweep and its measurements."""

    case_name: str
    inputs: tuple[Input, ...]
    control: str
    plan: SweepPlan
    swept: Swept
    files: tuple[Path, ...]

    @property
    def whole(self) -> bool:
        """Whether the sweep reached its end without a contact."""
        return not (self.plan.stopped or self.swept.contacts)

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        plan, off = self.plan, self.swept.off_mm
        return {
            "case": self.case_name,
            "control": self.control,
            "from_deg": np.degrees(plan.angles[0]).tolist(),
            "reached_deg": np.degrees(plan.angles[-1]).tolist(),
            "wanted_deg": np.degrees(plan.wanted).tolist(),
            "stopped": plan.stopped,
            "standoff_mm": plan.standoff_mm,
            "seconds": plan.sweep.duration_s,
            "off_point_mean_mm": float(off.mean()),
            "off_point_max_mm": float(off.max()),
            "contacts": [list(pair) for pair in self.swept.contacts],
            "inputs": inputs_document(self.inputs),
            "files": [str(path) for path in self.files],
        }


def sweep_case(context: CaseContext, out: Path, choice: Choice, to: Angles | None) -> SweepRun:
    """Plan a sweep to theta and beta, rad, execute it in the twin, write what was measured.

    None goes to the farthest direction of the start's window. Raises InputError: The case does not say where the robot
    stands. NoAnswerError: Nothing is safe, or the sweep cannot start; says why.
    """
    case, count = context.case, context.watcher.count
    with writing(out, "sweep", inputs=case.inputs, names=(SWEEP,), note=context.watcher.note) as draft:
        start, end = _ends(context, choice, to)
        with context.stages.time("sweep plan"):
            plan = plan_sweep(context, start, end, seed=case.rehearsal.seed, progress=partial(count, "directions"))
        assert context.placement is not None
        with context.stages.time("sweep"):
            swept = execute_sweep(plan, case, context.anatomy, context.placement.T_base_ct)
        files = draft.final((draft.folder / SWEEP,))
        run = SweepRun(case.name, case.inputs, case.rehearsal.control, plan, swept, files)
        write_result(run.summary(), draft.folder / SWEEP, out)
    return run


def sweep_end(source: Path, to: str | None, *, sweep: bool, alone: bool) -> Angles | None:
    """The end of a sweep from "THETA,BETA" in degrees; refused without a sweep, or of more than one case."""
    if not sweep:
        refuse("--to needs --sweep", "--to", "--sweep --to THETA,BETA", "conflicting_options")
    if is_plan(source) or not alone:
        refuse("a sweep needs one case", "--sweep", "a case, without plan and --seeds", "conflicting_options")
    return None if to is None else parse_angles(to)


def parse_angles(text: str) -> Angles:
    """Theta and beta (rad) of "THETA,BETA" in degrees."""
    numbers = [parse_coordinate(part.strip(), "--to") for part in text.split(",")]
    if len(numbers) != 2 or not (0 <= numbers[0] <= 180 and 0 <= numbers[1] <= 360):
        refuse(f"'{text[:40]}'", "--to", "THETA,BETA in degrees, 0 to 180 and 0 to 360", "not_a_number")
    return float(np.radians(numbers[0])), float(np.radians(numbers[1]))


def _ends(context: CaseContext, choice: Choice, to: Angles | None) -> tuple[Angles, Angles]:
    """Start and end of a sweep; the grid is searched only where it has to be."""
    if to is not None and not choice.of_grid:
        return chosen_angles(context.case, choice), to
    with context.stages.time("search"):
        candidates = context.search()
    chosen = choose(context, candidates, choice)
    row = int(chosen.rows[0])
    start = float(chosen.candidates.theta[row]), float(chosen.candidates.beta[row])
    if to is not None:
        return start, to
    windows = candidates.windows
    near = int(np.argmax(candidates.outward_ct @ chosen.candidates.outward_ct[row]))
    if not windows.of_row[near]:
        refuse("the direction is in no window of the grid", "--sweep", "--to THETA,BETA", "no_window")
    rows = windows.rows(int(windows.of_row[near]))
    far = int(rows[np.argmin(candidates.outward_ct[rows] @ candidates.outward_ct[near])])
    return start, (float(candidates.theta[far]), float(candidates.beta[far]))


def sweep_text(run: SweepRun) -> str:
    """Text of a sweep, for the terminal."""
    plan, off = run.plan, run.swept.off_mm
    start, end, wanted = (
        "theta {:.1f}, beta {:.1f}".format(*np.degrees(one)) for one in (plan.angles[0], plan.angles[-1], plan.wanted)
    )
    seconds = f"in {plan.sweep.duration_s:.1f} s, the tip {plan.standoff_mm:.0f} mm from the target"
    tcp = f"virtual TCP off its point: {off.mean():.4f} mm on average, {off.max():.4f} mm at most ({run.control})"
    stopped = [f"stopped there, on the way to {wanted} deg: {plan.stopped}"] if plan.stopped else []
    touched = (f"{link} touches {body}" for link, body in run.swept.contacts)
    return text([Section(f"swept from {start} to {end} deg {seconds}", [tcp, *stopped, *touched]), *footer(run.files)])
