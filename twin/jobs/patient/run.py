"""State of a command about a patient, as plain values (mm, degrees) and as text, and its files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import Severity, refuse
from puncture_twin.planning.base.output.output_set import Draft, writing
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.base.strict_json import plain
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.budget.guidance import check_way, stepped
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.certify.certificate import Certificate
from puncture_twin.planning.clearance.fcl_engine import CrossChecked
from puncture_twin.planning.geometry.containment import inside_each
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.registration.registration import Registration
from puncture_twin.planning.search.bedside import EntryFacts
from puncture_twin.planning.search.candidates import MOST_WINDOWS, Candidates, Pick, Window
from puncture_twin.planning.search.chances import touch_limit
from puncture_twin.planning.search.constraints import closest_miss
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import finite, needle_warnings, reason_text
from puncture_twin.planning.search.sides import sides_text
from puncture_twin.twin.report import patient
from puncture_twin.twin.report.numbers import TRUTH_IS_BELIEF
from puncture_twin.twin.report.present import Section, footer, text

if TYPE_CHECKING:
    from puncture_twin.twin.rehearsal.distribution import Distribution
    from puncture_twin.twin.rehearsal.result import Rehearsal


PAGE, SLICES = "report.html", "slices.png"
PICTURES = ("map.png", "scene.png", SLICES, PAGE)  # what a search writes; slices only where there is a direction
FILM, TRIALS = "rehearsal.mp4", "rooms.png"
NOTABLE = 0.05  # of an expected error: by as much two configurations' differ before people are told
SAME_AIM = 0.02  # rad: joints that differ by less are of one insertion, an arm's errors alike to a fiftieth


def case_draft(
    context: CaseContext,
    out: Path,
    command: str,
    names: Iterable[str],
    read: tuple[Input, ...] = (),
    source: Input | None = None,
) -> AbstractContextManager[Draft]:
    """A draft of a command's files, of its inputs and the case's; `source` of them is an earlier command's output."""
    inputs, made_from = (*read, *context.case.inputs), {} if source is None else {source.path: source.sha256}
    seconds, note = context.stages.seconds, context.watcher.note
    return writing(out, command, inputs=inputs, seconds=seconds, names=names, made_from=made_from, note=note)


class TrialCount(NamedTuple):
    """Number of trials, how many of them in the simulator too, the guidance if any, and its steps."""

    trials: int
    physics: int = 0
    guidance: str | None = None
    steps: int | None = None


def trial_count(
    trials: int | None, physics: int, guidance: str | None = None, steps: int | None = None
) -> TrialCount | None:
    """The trials that are wanted; None for none besides the one that is executed."""
    stepped(guidance, steps)
    if guidance is not None:
        check_way(guidance)
        if trials is None or physics:
            what = "--guidance leads the needle in trials without physics"
            refuse(what, "--guidance", "--guidance WAY --seeds N, without --physics", "conflicting_options")
    if physics > (trials or 0):
        refuse("--physics runs some of the trials", "--physics", "--seeds N --physics K, K <= N", "conflicting_options")
    return None if trials is None else TrialCount(trials, physics, guidance, steps)


@dataclass(frozen=True, eq=False)
class Run:
    """State and files of a command; `refusal` says why there is no plan although it makes one."""

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
        searched, row = pick
        return self.context.entry_facts(searched.path.entry_ct[row], searched.outward_ct[row])

    @property
    def failures(self) -> tuple[str, ...]:
        """How the rehearsed needle missed or touched, and where more trials did than the case allows; "" for none."""
        if self.rehearsal is None:
            return ()
        failed = () if self.distribution is None else trial_failures(self.context.case, self.distribution)
        return (*rehearsal_failures(self.context, self.rehearsal), *failed)

    def with_files(self, *files: Path) -> Run:
        """The run with more files."""
        return replace(self, files=(*self.files, *files))

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm and degrees."""
        candidates, provenance = self.candidates, self.context.provenance()
        all_windows = candidates.windows
        windows, largest = all_windows.windows, all_windows.largest
        at_patient = {} if self.facts is None else self.facts.summary()
        return {
            **provenance,
            "warnings": [*provenance["warnings"], *needle_warnings(self.context.case, candidates)],
            "findings": [*provenance["findings"], *(one.document() for one in candidates.findings)],
            "inputs": inputs_document(self.inputs),
            "headline": all_windows.headline,
            "largest_window": None if largest is None else window_summary(candidates, largest),
            "looked": sides_text(self.context.sides, searched=True),
            "sides": [side.document() for side in self.context.sides],
            "directions": len(candidates),
            "counts": candidates.counts(),
            "best": [window_summary(candidates, window) for window in windows[:MOST_WINDOWS]],
            "windows": len(windows),
            "safe_cone_from": candidates.cone_source,
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
        """Notes on the plan's expected error and its aim."""
        plan, chances = self.plan, self.candidates.chances
        if plan is None:
            return ()
        notes = [] if self.context.case.bending is None else ["The expected error assumes a straight needle."]
        if self.context.chance is None:
            notes.append("The expected error counts the markers alone: [errors] does not declare the arm's errors.")
        matches = (self.candidates.theta == plan.theta) & (self.candidates.beta == plan.beta)
        if chances is not None and matches.any():  # its row may be of another configuration
            other = float(np.hypot(chances.lateral_mm[matches][0], chances.depth_mm[matches][0]))
            if abs(other - plan.expected_target_error_mm) > NOTABLE * plan.expected_target_error_mm:
                configuration = f"In the configuration of the table and of check: {other:.2f} mm."
                notes.append(f"{configuration} The approach may end in another.")
        registration = None if self.context.placement is None else self.context.placement.registration
        aim, q = None if registration is None else registration.aim, plan.insertion.q[-1]
        if aim is not None and np.abs(q - aim.q).max() >= SAME_AIM:
            joints = ", ".join(f"{angle:.2f}" for angle in np.degrees(q))
            notes.append(
                f"The aim is corrected for another insertion. For this one, set correct_joints_deg = [{joints}]."
            )
        return tuple(notes)

    def text(self) -> str:
        """Text for a person: what must be read first, the search, then what was done with it; then the files."""
        anatomy, belief = self.context.anatomy, self.rehearsal is not None and self.rehearsal.truth_is_belief
        first = [Section(f"NOTE: {TRUTH_IS_BELIEF}", [])] if belief else []
        notes = [Section(f"note: {one.sentence}", []) for one in anatomy.findings if one.severity is Severity.NOTE]
        ending = footer(self.files, anatomy.warnings, self.context.stages.seconds)
        return text([*first, *self._searched(), *self._done(), *notes, *ending])

    def _searched(self) -> list[Section]:
        candidates, sides = self.candidates, self.context.sides
        looked = f", entry sides: {sides_text(sides, searched=True)}" if sides else ""
        warned = (*needle_warnings(self.context.case, candidates), *(one.sentence for one in candidates.findings))
        if candidates.safe.any():
            best = Section("the best of each window", patient.windows(candidates, self.context.anatomy.scan))
        elif (row := closest_miss(candidates)) is None:
            best = Section("no candidate is safe", [])
        else:
            angles = "theta {theta_deg:g} deg, beta {beta_deg:g} deg".format(**candidates.at(row))
            best = Section(f"no candidate is safe; the closest, {angles}: {reason_text(candidates, row)}", [])
        return [
            Section(f"case {self.context.case.name}: {candidates.windows.headline}", []),
            Section(f"{plural(len(candidates), 'direction')}{looked}", patient.counts(candidates)),
            *(Section(one, []) for one in warned),
            best,
        ]

    def _done(self) -> list[Section]:
        away = frozenset(one.name for one in self.context.anatomy.structures if one.demands_margin)
        at_patient = () if self.facts is None else self.facts.rows()
        declared = self.context.chance is not None
        done = []
        if self.plan is not None:
            done.append(Section("plan", patient.plan(self.plan, at_patient, declared=declared, notes=self.plan_notes)))
        if self.rehearsal is not None:
            done.append(Section("rehearsal", patient.rehearsal(self.rehearsal, away, failures=self.failures)))
        if self.distribution is not None:
            done.append(Section("many trials", patient.trials(self.distribution.summary())))
        if self.certificate is not None:
            done.append(Section("certificate", patient.certificate(self.certificate.summary())))
        if (checked := self.checked) is not None:
            done.append(Section(
                f"cross-check: FCL measured {checked.directions} directions again; {checked.pairs} distances agree,"
                f" largest difference {checked.largest_mm:.1e} mm", []))  # fmt: skip
        return done


def plain_fields(one: Any, *names: str) -> dict[str, Any]:
    """Some of a record's fields as JSON has them."""
    return {name: plain(getattr(one, name)) for name in names}


def registration_summary(registration: Registration) -> dict[str, Any]:
    """A registration as plain values: mm; of declared errors what they add."""
    uncertainty, distortion = registration.uncertainty, registration.distortion
    test = registration.residual_test if uncertainty is None else uncertainty.test
    declared = {}
    if uncertainty is not None:
        noise = uncertainty.test
        declared["declaration"] = {
            "holds": noise.agrees,
            "probability": noise.probability,
            "residuals_over_declared": noise.estimate,
            "interval": list(noise.interval),
            "text": noise.text(),
        }
    distorted = None
    if distortion is not None:
        distorted = {**vars(distortion), "doubted": distortion.significant, "text": distortion.finding().sentence}
    return {
        **plain_fields(registration, "method", "T_base_ct"),
        "residual_mm": dict(zip(registration.markers.names, registration.residual_mm.tolist(), strict=True)),
        **plain_fields(registration, "fre_mm", "mean_error_mm", "fle_mm", "fle_source"),
        "fle_interval_mm": list(registration.fle_interval_mm),
        "chi_squared": finite(test.chi_squared),
        "degrees_of_freedom": test.freedom,
        "noise_scale": test.scale,
        **declared,
        **plain_fields(registration.conditioning, "spread_ratio", "altitude_mm", "leverage"),
        "distortion": distorted,
        "flags": [flag.sentence for flag in registration.flags],
        "findings": [flag.document() for flag in registration.flags],
    }


def window_summary(candidates: Candidates, window: Window) -> dict[str, Any]:
    """A window by its best candidate, as plain values: mm and degrees."""
    row = window.best
    return {
        "rank": int(candidates.ranking.rank[row]),
        **candidates.at(row),
        "cost": finite(candidates.ranking.cost[row]),
        "min_clearance_mm": finite(candidates.least_clearance[row]),
        "path_length_mm": finite(candidates.path.length[row]),
        "skin_angle_deg": finite(np.degrees(candidates.path.skin_angle[row])),
        "tissue_mm": finite(candidates.path.tissue[row]),
        "reach_margin": finite(candidates.arm.margin[row]),
        "safe_cone_deg": finite(np.degrees(candidates.safe_cone[row])),
        "pareto": bool(candidates.ranking.pareto[row]),
        "window": window.number,
        "window_directions": window.directions,
        "window_square_deg": window.square_deg,
        "window_entry_cm2": window.entry_cm2,
        "window_wide_deg": window.wide_deg,
        "window_widest_cone_deg": finite(np.degrees(window.widest_cone)),
    }


def plan_summary(plan: Plan) -> dict[str, Any]:
    """A plan's main numbers as plain values."""
    return {
        "theta_deg": float(np.degrees(plan.theta)),
        "beta_deg": float(np.degrees(plan.beta)),
        "entry_ct_mm": plan.entry_ct.tolist(),
        "standoff_mm": plan.standoff_mm,
        "expected_target_error_mm": finite(plan.expected_target_error_mm),
        "approach_s": float(plan.approach.times_s[-1]),
        "insertion_s": float(plan.insertion.times_s[-1]),
        "clearance_mm": {phase: finite(value) for phase, value in plan.clearance_mm.items()},
        **({"guidance": [one.document() for one in plan.guidance]} if plan.guidance else {}),
    }


def rehearsal_summary(rehearsal: Rehearsal) -> dict[str, Any]:
    """A rehearsal's main numbers as plain values; the needle's end in LPS, or the case's local frame."""
    forward = np.linalg.inv(rehearsal.T_base_ct_true)[:3, :3] @ rehearsal.T_base_flange_true[-1, :3, 2]
    return {
        **plain_fields(rehearsal, "seed", "tip_error_mm", "lateral_mm", "depth_mm", "predicted_error_mm"),
        "contacts": [f"{c.link} touches {c.body} at {c.time_s:.2f} s" for c in rehearsal.contacts],
        "least_clearance_mm": {name: float(np.min(values)) for name, values in rehearsal.clearance_mm.items()},
        **plain_fields(rehearsal, "control", "off_path_mm"),
        "tissue_n": None if rehearsal.tissue_force is None else rehearsal.tissue_force._asdict(),
        "needle_end": {
            "tip_ct_mm": rehearsal.tip_true_ct[-1].tolist(),
            "direction_ct": forward.tolist(),
            "target_ct_mm": rehearsal.target_true_ct.tolist(),
        },
        "max_joint_speed_deg_s": np.degrees(rehearsal.max_joint_speed).tolist(),
        "joint_speed_limit_deg_s": np.degrees(rehearsal.speed_limits).tolist(),
        **({} if rehearsal.standing is None else rehearsal.standing.summary()),
    }


def rehearsal_failures(context: CaseContext, rehearsal: Rehearsal) -> tuple[str, ...]:
    """How the needle of one trial missed its target, and what it or the arm touched, one sentence each."""
    avoided = (one.name for one in context.anatomy.checked if one.demands_margin)
    touched = [name for name in avoided if np.min(rehearsal.clearance_mm.get(name, np.inf)) < 0.0]
    case, tip_ct = context.case, rehearsal.tip_true_ct[-1:]
    if case.hit_radius_mm is not None:
        hit = bool(np.linalg.norm(tip_ct[0] - rehearsal.target_true_ct) < case.hit_radius_mm)
    else:
        hit = bool(inside_each(context.anatomy.structure(case.target_structure).mesh, tip_ct)[0])
    return (
        *([] if hit else ["the tip missed the target"]),
        *(f"the needle touched {name}" for name in touched),
        *sorted({f"the arm's {one.link} touched {one.body}" for one in rehearsal.contacts}),
    )


def trial_failures(case: Case, distribution: Distribution) -> Iterator[str]:
    """Where more trials missed or touched than the case's limits of the chances allow, one sentence each."""
    if not len(distribution):
        yield "in no trial did the needle reach the target"
        return
    least, hit, touched = case.search.min_hit or 0.0, distribution.hit_share or 0.0, distribution.touched.mean(axis=0)
    if hit < least:
        yield f"{100 * hit:.2f} % of the trials hit the target; search.min_hit demands {100 * least:.2f} %"
    for name, fraction in zip(distribution.structures, touched.tolist(), strict=True):
        if fraction > (most := touch_limit(case, name)):
            yield f"{100 * fraction:.2f} % of the trials touched {name}; the case allows {100 * most:.2f} %"
