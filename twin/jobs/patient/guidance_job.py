"""`rehearse --guidance ct,us,...`: several ways of guidance along one plan, the same patients for each, on one page.

Best first. A way is worse than the best where clearly more of all its trials fail (stopped, out of reach, missed or
touched), or where its tip error is clearly larger: by more than two standard errors of the difference. Beside them
what is published of needles that are inserted, scanned and corrected by hand.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.budget.guidance import equipped, sight_of
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.search.choice import Choice
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.uncertainty_breakdown import LEAST_FRACTION
from puncture_twin.planning.uncertainty.guided import WAYS
from puncture_twin.planning.uncertainty.sources import SOURCES
from puncture_twin.twin.jobs.patient.main_job import checked_plan, is_plan, plan_case
from puncture_twin.twin.jobs.patient.run import case_draft, plan_summary, trial_failures
from puncture_twin.twin.jobs.terminal import write_result
from puncture_twin.twin.rehearsal.distribution import Distribution, rehearse_trials
from puncture_twin.twin.report import present
from puncture_twin.twin.report.error_pictures import ALONE, BETTER, WORSE, draw_clouds
from puncture_twin.twin.report.present import Card, Field, Section, Table, Warn, grid, number, percent

PAGE, PICTURE, TABLE = FILES = ("ways.html", "ways.png", "ways.json")
SAME_PATIENTS = "one plan, the same patients for every way."
CLEAR = 2.0  # standard errors of a difference that make it clear
LOOK_S = {"camera_pairs": 5.0, "pictures": 30.0}  # of a look; assumed: a program reads cameras, a person a picture
COLOURS = {"best": BETTER, "as good": ALONE, "worse": WORSE}


class Rated(NamedTuple):
    """A guidance and its rating: best, as good or worse, and in what; `failed` is the fraction of all trials."""

    distribution: Distribution
    failed: float
    rating: str
    why: str


def rated(distributions: list[Distribution]) -> tuple[Rated, ...]:
    """Guidances with the same number of trials each, rated, the best first."""
    count = len(distributions[0]) + distributions[0].stopped + distributions[0].unreached
    failed = np.array([1.0 - float((one.hit & ~one.touched.any(axis=1)).sum()) / count for one in distributions])
    variance = failed * (1.0 - failed) / count
    least = int(failed.argmin())
    fails = failed > failed[least] + CLEAR * np.sqrt(variance + variance[least])
    square = np.array([np.mean(one.tip_error_mm**2) if len(one) else np.inf for one in distributions])
    spread = np.array([np.std(one.tip_error_mm**2) / np.sqrt(len(one)) if len(one) else 0.0 for one in distributions])
    first, *_ = order = np.lexsort((square, fails)).tolist()
    larger = np.isfinite(square) & (square > square[first] + CLEAR * np.hypot(spread, spread[first]))
    rows = []
    for row in order:
        times = f"error ×{number(np.sqrt(square[row] / square[first]), 2)}" if larger[row] else ""
        why = ", ".join(filter(None, ("more trials fail" if fails[row] else "", times)))
        rating = "best" if row == first else "worse" if why else "as good"
        rows.append(Rated(distributions[row], float(failed[row]), rating, why))
    return tuple(rows)


@dataclass(frozen=True)
class Compared:
    """Guidances along one plan, the best first; those without an answer, and why; files written, files read."""

    context: CaseContext
    plan: Plan
    ranked: tuple[Rated, ...]
    unknown: Mapping[str, str]
    read: tuple[Input, ...]
    files: tuple[Path, ...] = ()

    def failures(self, one: Rated) -> list[str]:
        """Sentences where more of a guidance's trials missed or touched than the case allows."""
        return list(trial_failures(self.context.case, one.distribution))

    @property
    def passed(self) -> bool:
        """Whether one guidance at least keeps to what the case allows."""
        return not all(map(self.failures, self.ranked))

    def rows(self) -> list[dict[str, Any]]:
        """Each guidance as `rehearse --json` has its distribution, compared with the best, and its time."""
        moving = self.plan.approach.duration_s + self.plan.insertion.duration_s
        looks = [sum(seconds * one.distribution.looks[kind] for kind, seconds in LOOK_S.items()) for one in self.ranked]
        return [
            {**one.distribution.summary(), "rating": one.rating, "worse_in": one.why, "failed_share": one.failed,
             "seconds": moving + seconds, "failures": self.failures(one)}
            for one, seconds in zip(self.ranked, looks, strict=True)
        ]  # fmt: skip

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm, degrees, fractions 0..1."""
        return {
            **self.context.provenance(),
            "inputs": inputs_document((*self.read, *self.context.case.inputs)),
            "plan": plan_summary(self.plan),
            "ways": [*self.rows(), *({"guidance": name, "no_answer": why} for name, why in self.unknown.items())],
            "assumed_look_s": dict(LOOK_S),
            "files": [str(path) for path in self.files],
        }

    def sections(self) -> list[Section]:
        """Sections for terminal and page."""
        rows = self.rows()
        first, patients = rows[0], plural(rows[0]["rooms"], "patient")
        lost = [f"{row['guidance']}: {one}" for row in rows for one in (*row["failures"], *row["lost_sight"])]
        lost += [f"{guidance}: {why}" for guidance, why in self.unknown.items()]
        said = [f"Not modelled: {first['not_modelled']}."]
        said += dict.fromkeys(one for row in rows for one in row["assumed"])
        said += [f"The needle pushes the target on by {first['pushed_mm']:.2f} mm."] if "pushed_mm" in first else []
        said += ["The trials were drawn from [rehearsal.errors]: the belief is wrong."] * first["wrong_belief"]
        said += ["How the arm touched the markers is not known: a posture was assumed."] * first["guessed_touches"]
        title = f"the same {patients} by each way of guidance, seed {first['seed']}; best first"
        return [
            Section(title, [grid(OUTCOME, rows), Warn(tuple(lost)), WORSE_TEXT, *said]),
            Section("tip error by source, rms in mm (squares add up)", [self._sources()]),
            Section("devices, looks, time and dose", [grid(EFFORT, rows), EFFORT_TEXT]),
            Section("by hand: insert, scan, correct", [BY_HAND, HAND_TEXT]),
        ]

    def _sources(self) -> Table:
        budgets = [one.distribution.budget for one in self.ranked]
        names = {name for one in budgets for name, part in one.fraction.items() if part >= LEAST_FRACTION}
        parts = {name: [np.sqrt(one.fraction.get(name, 0.0)) * one.rms_mm for one in budgets] for name in names}
        order = sorted(names, key=lambda name: (-max(parts[name]), name))
        shown = [*((SOURCES[name].text, parts[name]) for name in order), ("all", [one.rms_mm for one in budgets])]
        rows = tuple((text, *(number(part, 2) for part in row)) for text, row in shown)
        return Table(("source", *(str(one.distribution.guidance) for one in self.ranked)), rows)

    def text(self) -> str:
        """What a person reads."""
        title = Section(
            f"case {self.context.case.name}, θ {self.plan.theta_deg:g}°, β {self.plan.beta_deg:g}°: {SAME_PATIENTS}", []
        )
        return present.text([title, *self.sections(), *present.footer(self.files, self.context.anatomy.warnings)])

    def write(self, folder: Path) -> None:
        """Write page and picture."""
        shown = [(one.distribution, one.rating, COLOURS[one.rating]) for one in self.ranked]
        draw_clouds(shown, self.plan.outward_ct, folder / PICTURE, self.context.case.hit_radius_mm)
        cards = [
            Card(f"{one.distribution.guidance}: {one.rating}", number(one.distribution.realised_rms_mm, 2, "mm rms"),
                 f"{percent(1 - one.failed)} of all trials hit and touched nothing",
                 one.rating == "worse" or bool(self.failures(one)))
            for one in self.ranked
        ]  # fmt: skip
        clouds = present.picture(folder / PICTURE, "error clouds of each way of guidance")
        first, *rest = self.sections()
        sections = [first, Section("where the tip ended", [clouds, CLOUD_TEXT]), *rest]
        inputs, seed = (*self.read, *self.context.case.inputs), self.ranked[0].distribution.seed
        title = f"Ways of guidance of {self.context.case.name}"
        under = f"θ {self.plan.theta_deg:g}°, β {self.plan.beta_deg:g}°: {SAME_PATIENTS}"
        present.write_page(folder / PAGE, title, under, cards, sections, inputs, origin=present.origin_section(seed))


def _rating(row: Mapping[str, Any]) -> str:
    return Markup('<b class="bad">worse: {}</b>').format(row["worse_in"]) if row["rating"] == "worse" else row["rating"]


def _part(name: str, key: str) -> Field:
    return Field(name, lambda row: None if row[key] is None else percent(row[key]))


def _devices(row: Mapping[str, Any]) -> str:
    names = {"touch": "markers, touched", "cameras": "cameras", "target": "ultrasound", "tip": "needle in ultrasound"}
    return ", ".join(name for device, name in names.items() if device in WAYS[row["guidance"]])


OUTCOME = (
    Field("guidance", "guidance"), Field("against the best", _rating),
    Field("tip error (rms)", "realised_rms_mm", 2, "mm"), Field("predicted", "predicted_rms_mm", 2, "mm"),
    _part("in the 95 % region", "coverage_95"), _part("hits", "hit_share"), _part("predicted hits", "mean_p_hit"),
    _part("touches", "touch_share"), _part("predicted touches", "mean_p_touch"), Field("stopped", "stopped"),
    Field("out of reach", "unreached"), _part("failed of all", "failed_share"),
)  # fmt: skip
WORSE_TEXT = (
    "Worse: clearly more of all trials fail (stopped, out of reach, missed or touched), or the error is clearly "
    "larger, by two standard errors. Tip error, region and touches are of the trials that were executed; hits are of "
    "all that the arm could reach, and a stopped needle does not hit."
)
CLOUD_TEXT = "All to one scale. +: true target; line: predicted 95 % ellipsoid; crosses: outside it; dotted: hit."
EFFORT = (
    Field("guidance", "guidance"), Field("devices", _devices), Field("touches read", "looks.touches"),
    Field("camera pairs", "looks.camera_pairs"), Field("ultrasound pictures", "looks.pictures"),
    Field("time", lambda row: row["seconds"] / 60.0, 1, "min"), Field("dose", lambda _: "the planning CT's"),
)  # fmt: skip
EFFORT_TEXT = (
    f"Time: approach and insertion of the plan, and for each look {LOOK_S['camera_pairs']:g} s (a pair of cameras) or "
    f"{LOOK_S['pictures']:g} s (an ultrasound picture): assumed, not measured. Not in it: planning, set-up, "
    "calibration, and the touches that give every way its registration, direction and corridor. No way takes another "
    "CT while it guides; a control scan would add its own dose."
)
BY_HAND = Table(  # means of the needles by hand, as the abstracts print them
    ("published of", "tip error (mean), mm", "corrections after a first pass", "dose, mGy cm", "time, min", "source"),
    (
        ("abdominal phantom, CT scans", "4.6", "1.7", "–", "21.0", "Eur J Radiol 2023;162:110753 (PubMed 36863276)"),
        ("swine liver in vivo, CT fluoroscopy", "4.5", "4.6", "1076", "6.1",
         "Cornelis et al., manual and robotic placements in swine liver (synapse.mskcc.org/synapse/works/81169)"),
        ("patients' liver ablations, CT fluoroscopy", "3.3", "–", "2881", "21.7",
         "Beyer et al., Int J CARS 2016;11:253 (doi 10.1007/s11548-015-1286-y)"),
    ), "",
)  # fmt: skip
HAND_TEXT = (
    "Published means, of other targets, depths and operators: an order of size, not rehearsed here. A dash is not "
    "stated there; the second prints its dose as mGy/cm. Their times are of whole procedures or placements, ours of "
    "motions and looks alone."
)


def compare_guidance(
    context: CaseContext, source: Path, out: Path, guidances: tuple[str, ...], count: int, choice: Choice
) -> Compared:
    """Compare guidances along a plan, or along a case's best or chosen direction; write page and picture."""
    started, planned = None, tuple[Path, ...]()
    if is_plan(source):
        started, plan, _ = checked_plan(context, source)
        read: tuple[Input, ...] = (started,)
    else:
        run = plan_case(context, out, choice)
        assert run.plan is not None  # else it has raised
        plan, read, planned = run.plan, run.read, run.files
    with case_draft(context, out, "rehearse", FILES, read, started) as draft:
        done = Compared(context, plan, *_rehearsed(context, plan, guidances, count), read)
        done.write(draft.folder)
        done = replace(done, files=(*planned, *draft.final(tuple(draft.folder / name for name in FILES))))
        write_result(done.summary(), draft.folder / TABLE, out)
    return done


def _rehearsed(
    context: CaseContext, plan: Plan, guidances: tuple[str, ...], count: int
) -> tuple[tuple[Rated, ...], dict[str, str]]:
    distributions, unknown, case = list[Distribution](), dict[str, str](), context.case
    for guidance in guidances:
        case, _ = equipped(case, guidance)
    with context.stages.time("rooms"):
        sight_line = sight_of(replace(context, case=case), plan, *guidances)
        seed, q = context.case.rehearsal.seed, plan.insertion.q[-1]
        for guidance in guidances:
            try:
                distributions.append(rehearse_trials(context, plan.outward_ct, q, count, seed, guidance, sight_line))
            except NoAnswerError as error:
                unknown[guidance] = str(error)
    if not distributions:
        raise NoAnswerError("; ".join(unknown.values()), code="lost_sight")
    return rated(distributions), unknown
