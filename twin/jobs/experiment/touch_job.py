"""Markers touched in the twin: planned, executed by the ground truth, written as `registration` reads them.

A reading lies some hundredths of a millimetre from the joints that put the true tip on the true marker: a physical run
and its drawn twin err alike.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats, rms
from puncture_twin.planning.base.errors import InputError, NoAnswerError
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.base.strict_json import or_null
from puncture_twin.planning.base.text import Shown, plural
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.formats.points import NamedPoints, write_points
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS
from puncture_twin.planning.registration.registration import Registration
from puncture_twin.planning.search.choice import BEST, Choice, choose
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.touch.touch_planner import (
    TOUCHING_PADDING_MM,
    approach_checkers,
    expected_of_touches,
    plan_touches,
    registered,
)
from puncture_twin.planning.touch.tour_motions import TouchPlan, plan_puncture, registered_joints
from puncture_twin.twin.guidance.ct.touching import Touched, nominal_tip
from puncture_twin.twin.jobs.terminal import write_result
from puncture_twin.twin.plant.touching import ExecutedTouches, execute_touches
from puncture_twin.twin.plant.true_needle import AtTarget, TouchTruth, draw_at_target, draw_touch_truth, true_needle
from puncture_twin.twin.rehearsal.distribution import misregistered
from puncture_twin.twin.rehearsal.plan_truth import rehearse_touched
from puncture_twin.twin.report.present import Field, Section, footer, grid, text

TOUCH, SUMMARY = "touch.csv", "touch.json"
DRAWS = 400  # where one axis errs most their rms is known to 3.5 %


class Use(NamedTuple):
    """Quality of readings: the tip's expected error (rms) at the target, and that of the erring arm in truth."""

    registration: Registration
    expected_mm: float
    tip_error_mm: float


@dataclass(frozen=True, eq=False, repr=False)
class TouchRun(Shown):
    """Planned touches, their readings, and the quality of these, or in words why they do not register."""

    case_name: str
    inputs: tuple[Input, ...]
    seed: int
    plan: TouchPlan
    touched: ExecutedTouches
    use: Use | str
    files: tuple[Path, ...] = ()

    @property
    def points(self) -> NamedPoints:
        """The readings by their markers' names, base frame, mm, with the joints: what `registration` takes."""
        return _points(self.touched)

    @property
    def suffices(self) -> bool:
        """Whether the readings register."""
        return not isinstance(self.use, str)

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        use = None if isinstance(self.use, str) else self.use
        return {
            "case": self.case_name,
            "seed": self.seed,
            "touches": [
                {
                    "marker": one.name,
                    "point_mm": one.point_base.tolist(),
                    "joints_deg": np.degrees(one.q).tolist(),
                    "seconds": one.seconds,
                    "force_n": one.force_n,
                    "aside_mm": one.aside_mm,
                    **self.touched.contacts[one.name]._asdict(),
                }
                for one in self.touched.readings
            ],
            "left_out": dict(self.plan.left_out),
            "failed": dict(self.touched.failed),
            "suffices": self.suffices,
            "seconds": self.touched.seconds,
            "seconds_per_touch": _per_touch(self.touched),
            "expected_of_best_poses_mm": self.plan.expected_mm,
            "expected_of_worst_poses_mm": self.plan.worst_mm,
            "why_not": self.use if use is None else "",
            "expected_tip_error_mm": use and use.expected_mm,
            "tip_error_mm": use and use.tip_error_mm,
            "fre_mm": use and use.registration.fre_mm,
            "flags": [] if use is None else [flag.sentence for flag in use.registration.flags],
            "inputs": inputs_document(self.inputs),
            "files": [str(path) for path in self.files],
        }


def touch_case(context: CaseContext, out: Path, choice: Choice, seed: int) -> TouchRun:
    """Plan the touches of a case's markers for a chosen puncture, execute them in the twin, write what they read.

    Raises InputError: No declared errors, or no markers. NoAnswerError: Nothing is safe, or too few can be touched.
    """
    with writing(out, "touch", inputs=context.case.inputs, names=(TOUCH, SUMMARY), note=context.watcher.note) as draft:
        run = touch(context, choice, seed)
        names = (TOUCH, SUMMARY) if run.touched.readings else (SUMMARY,)
        run = replace(run, files=draft.final(tuple(draft.folder / name for name in names)))
        if run.touched.readings:
            write_points(draft.folder / TOUCH, run.points)
        write_result(run.summary(), draft.folder / SUMMARY, out)
    return run


def touch(context: CaseContext, choice: Choice, seed: int) -> TouchRun:
    """Plan the touches and execute them in the twin; see `touch_case`."""
    planned = plan_tour(context, choice, seed)
    touched, use = touch_once(context, planned, seed)
    return TouchRun(context.case.name, context.case.inputs, seed, planned.plan, touched, use)


class Tour(NamedTuple):
    """A tour of the markers and the puncture that it is for: joints (6,), rad, and its direction outward (3,)."""

    plan: TouchPlan
    q_insertion: Floats
    outward_ct: Floats


def plan_tour(context: CaseContext, choice: Choice, seed: int) -> Tour:
    """Plan the touches for a chosen puncture."""
    context.require_arm()
    q_insertion, outward_ct = _puncture(context, choice)
    with context.stages.time("touch plan"):
        plan = plan_touches(context, q_insertion, seed=seed, progress=partial(context.watcher.count, "motions"))
    return Tour(plan, q_insertion, outward_ct)


def touch_once(context: CaseContext, tour: Tour, seed: int) -> tuple[ExecutedTouches, Use | str]:
    """Execute a tour by the ground truth of one draw of the errors; the touches, and the quality of their readings."""
    truth = true_touches(context, tour, seed)
    checkers, count = approach_checkers(context, TOUCHING_PADDING_MM), partial(context.watcher.count, "touches")
    with context.stages.time("touches"):
        touched = execute_touches(tour.plan, context.case, context.anatomy, checkers, truth, count)
    return touched, _use(context, tour, truth, _points(touched))


def use_without_physics(context: CaseContext, tour: Tour, seed: int) -> Use | str:
    """Quality of a tour in the same truth without physics, where every touch reads its joints exactly."""
    plan, truth = tour.plan, true_touches(context, tour, seed)
    joints = np.array([truth.q_contact(plan.model, plan.tip_mm, touch) for touch in plan.touches])
    points = np.array([nominal_tip(plan.model, plan.tip_mm, q) for q in joints])
    names = tuple(touch.name for touch in plan.touches)
    return _use(context, tour, truth, NamedPoints(names, points, None, joints=joints))


def _use(context: CaseContext, tour: Tour, truth: TouchTruth, read: NamedPoints) -> Use | str:
    """Quality of readings, or in words why they do not suffice."""
    if len(read.names) < MIN_MARKERS:
        return f"{len(read.names)} of {len(tour.plan.touches)} markers were touched; {MIN_MARKERS} are needed"
    assert context.placement is not None
    plan, target_ct, at_target = tour.plan, context.case.target_ct, true_at_target(context, truth.seed)
    try:
        fitted = registered(context, read)
        expected = expected_of_touches(context, tour.q_insertion, read)
        beliefs = (context.placement.T_base_ct, fitted.T_base_ct)  # the arm is sent to where the new one has the target
        q = registered_joints(plan.model, plan.tip_mm, tour.q_insertion, target_ct, beliefs)
    except InputError as error:
        return error.what
    except NoAnswerError as error:
        return str(error)
    tip = true_needle(plan.model, q + at_target.arrival, truth.eta, plan.tip_mm).tip_base
    missed = tip - apply(truth.T_base_ct, at_target.target_ct)
    return Use(fitted, expected, float(np.linalg.norm(missed)))


def _puncture(context: CaseContext, choice: Choice) -> tuple[Floats, Floats]:
    """Joints (6,) with the tip on the target, and the direction outward (3,), of the best candidate of a choice."""
    with context.stages.time("search"):
        chosen = choose(context, None, choice)
    rows = [row for row in chosen.rows if np.isfinite(chosen.candidates.arm.q_insertion[row]).all()]
    if not rows:
        what = "the arm does not reach this candidate: no touches are planned for it"
        raise NoAnswerError(what, code="no_safe_direction")
    return chosen.candidates.arm.q_insertion[rows[0]], chosen.candidates.outward_ct[rows[0]]


def true_touches(context: CaseContext, tour: Tour, seed: int) -> TouchTruth:
    """Ground truth of the touches: the belief is one registration that the declared errors allow."""
    errors = _true_errors(context)
    assert context.placement is not None and context.placement.registration is not None
    E = misregistered(context, tour.outward_ct, tour.q_insertion, seed)
    markers = context.placement.registration.markers
    T_base_ct = context.placement.T_base_ct @ np.linalg.inv(E)
    return draw_touch_truth(T_base_ct, markers.names, markers.points_ct, errors, seed)


def _points(touched: Touched) -> NamedPoints:
    readings = touched.readings
    points = np.array([one.point_base for one in readings]).reshape(-1, 3)
    joints = np.array([one.q for one in readings]).reshape(-1, 6)
    return NamedPoints(tuple(one.name for one in readings), points, None, joints=joints)


def true_at_target(context: CaseContext, seed: int) -> AtTarget:
    """Ground truth when the needle arrives, by one draw of the declared errors."""
    return draw_at_target(context.case.target_ct, _true_errors(context), seed)


def _true_errors(context: CaseContext) -> ErrorModel:
    errors = context.case.truth_errors or context.case.errors
    assert errors is not None
    return errors


TOUCHED = (
    Field("marker", "marker"),
    Field("took", "seconds", 1, "s"),
    Field("contact, depth", "bias_mm", 3, "mm"),
    Field("at", "speed_mm_s", 1, "mm/s"),
    Field("at most", "force_n", 2, "N"),
    Field("line moved at the standoff", "aside_mm", 1, "mm"),
)


def touch_text(run: TouchRun) -> str:
    """Text of the touches, for the terminal."""
    plan, touched, use = run.plan, run.touched, run.use
    each = f", {_per_touch(touched):.1f} s each" if touched.readings else ""
    of = f" of {len(touched.readings) + len(touched.failed)}" if touched.failed else ""
    left = (f"{name} not touched: {why}" for name, why in (*plan.left_out.items(), *touched.failed.items()))
    head = f"{len(touched.readings)}{of} markers touched in {touched.seconds:.0f} s{each}"
    if isinstance(use, str):
        said = [Section(f"no registration: {use}", [])]
    else:
        failed, worst = ", ".join(touched.failed), f"with the worst poses {plan.worst_mm:.2f} mm"
        without = f" without {failed}, {plan.expected_mm:.2f} with them" if failed else ""
        truth = f"error in this trial (seed {run.seed}): {use.tip_error_mm:.2f} mm"
        flags = [flag.sentence for flag in use.registration.flags]
        said = [
            Section(f"expected tip error: {use.expected_mm:.2f} mm rms{without}; {worst}", []),
            Section(f"{truth}; FRE {use.registration.fre_mm:.2f} mm", flags),
        ]
    return text([Section(head, [grid(TOUCHED, run.summary()["touches"]), *left]), *said, *footer(run.files)])


def _per_touch(touched: Touched) -> float | None:
    """Seconds for each marker that was read."""
    return touched.seconds / len(touched.readings) if touched.readings else None


def physical_runs(context: CaseContext, runs: int) -> dict[str, Any]:
    """Run the experiment of a case's best candidate, each run with a truth of its own; returns plain values.

    They are the tip's rms error that the declaration predicts for these touches and that of the runs that ended, each
    of these, why others were refused, and the errors of truths without physics, the same and many. Raises as
    `touch_case`.
    """
    tour, ended, refused = plan_tour(context, BEST, seed=0), [], {}
    for seed in range(runs):
        try:
            ended.append(physical_run(context, tour, seed))
        except NoAnswerError as error:
            refused[seed] = str(error)
        context.watcher.count("runs", seed + 1, runs)
    uses = {seed: use_without_physics(context, tour, seed) for seed in range(max(DRAWS, runs))}
    errors_mm = {seed: float("nan") if isinstance(use, str) else use.tip_error_mm for seed, use in uses.items()}
    alike = [errors_mm[one["seed"]] for one in ended if np.isfinite(errors_mm[one["seed"]])]
    return {
        "expected_mm": tour.plan.expected_mm,
        "realised_mm": or_null(rms([one["tip_error_mm"] for one in ended])),
        "seconds_per_touch": float(np.mean([one["seconds_per_touch"] for one in ended])) if ended else None,
        "drawn": {
            "realised_mm": rms([errors_mm[seed] for seed in range(DRAWS) if np.isfinite(errors_mm[seed])]),
            "draws": DRAWS,
            "realised_in_the_same_truths_mm": or_null(rms(alike)),
        },
        "refused": refused,
        "runs": ended,
    }


def physical_run(context: CaseContext, tour: Tour, seed: int) -> dict[str, Any]:
    """Run the experiment once, with the truth of a seed."""
    touched, use = touch_once(context, tour, seed)
    if touched.failed or isinstance(use, str):
        why = "; ".join(f"marker {name}: {reason}" for name, reason in touched.failed.items())
        raise NoAnswerError(why or str(use), code="no_touch")
    with context.stages.time("puncture"):  # planned by what was touched, and executed where everything truly is
        plan = plan_puncture(context, tour.outward_ct, tour.q_insertion, use.registration)
        truth, at_target = true_touches(context, tour, seed), true_at_target(context, seed)
        inserted = rehearse_touched(context, plan, truth, at_target)
    for contact in inserted.contacts:
        what = f"the arm stopped before the target: {contact.link} touches {contact.body}"
        raise NoAnswerError(what, code="motion_touches")
    return {
        "seed": seed,
        "tip_error_mm": inserted.tip_error_mm,
        "fre_mm": use.registration.fre_mm,
        "seconds_per_touch": touched.seconds / len(touched.readings),
        "off_path_mm": inserted.off_path_mm,
        "refused": "",
    }


def physical_text(facts: Mapping[str, Any]) -> str:
    """Text of physical runs; where one axis errs most, an rms is known to one over the root of twice their number."""
    ended, drawn = facts["runs"], facts["drawn"]
    refused = [f"seed {seed}: {why}" for seed, why in facts["refused"].items()]
    if not ended:
        return text([Section(f"none of {plural(len(refused), 'physical run')} ended", refused)])
    known, draws = (100.0 / np.sqrt(2.0 * count) for count in (len(ended), drawn["draws"]))
    head = (
        f"{plural(len(ended), 'physical run')} ({facts['seconds_per_touch']:.1f} s per touch): the tip misses the "
        f"target by {facts['realised_mm']:.2f} mm rms (known to {known:.0f} %), {facts['expected_mm']:.2f} predicted"
    )
    off_mm = max(run["off_path_mm"] for run in ended)
    said = [
        f"touched and inserted in the simulator, the tip at most {off_mm:.3f} mm off its commanded path",
        f"without physics, the same {plural(len(ended), 'trial')} give {drawn['realised_in_the_same_truths_mm']:.2f} "
        f"mm, all {drawn['draws']} trials {drawn['realised_mm']:.2f} (known to {draws:.1f} %)",
    ]
    return text([Section(head, [*said, *refused])])
