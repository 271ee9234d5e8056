"""Markers touched in the twin: planned, executed where everything truly is, written as `registration` reads them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, NoAnswerError
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.base.text import Shown
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.formats.points import NamedPoints, write_points
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS
from puncture_twin.planning.registration.registration import Registration
from puncture_twin.planning.search.choice import Choice, choose
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.touch.touch_planner import (
    TOUCHING_PADDING_MM,
    approach_checkers,
    expected_of_touches,
    plan_touches,
    registered,
)
from puncture_twin.planning.touch.tour_motions import TouchPlan, registered_joints
from puncture_twin.twin.guidance.ct.touching import Touched, nominal_tip
from puncture_twin.twin.jobs.terminal import write_result
from puncture_twin.twin.plant.touching import ExecutedTouches, execute_touches
from puncture_twin.twin.plant.true_needle import (
    AtTarget,
    TouchTruth,
    draw_at_target,
    draw_touch_truth,
    true_needle,
)
from puncture_twin.twin.rehearsal.distribution import misregistered
from puncture_twin.twin.report.present import Field, Section, footer, grid, text

TOUCH, SUMMARY = "touch.csv", "touch.json"


class Use(NamedTuple):
    """What readings are good for."""

    registration: Registration
    expected_mm: float
    """Of the tip at the target (rms)."""
    tip_error_mm: float
    """Where the erring arm, sent to the target by that registration, puts its tip."""

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "why_not": "",
            "expected_tip_error_mm": self.expected_mm,
            "tip_error_mm": self.tip_error_mm,
            "fre_mm": self.registration.fre_mm,
            "flags": [flag.sentence for flag in self.registration.flags],
        }


def _no_use(why: str) -> dict[str, Any]:
    """The use of readings that register nothing, with the reason."""
    return {"why_not": why, "expected_tip_error_mm": None, "tip_error_mm": None, "fre_mm": None, "flags": []}


@dataclass(frozen=True, eq=False, repr=False)
class TouchRun(Shown):
    """What was planned, what was read, and what it is good for.

    Attributes:
        use: What the readings are good for; in words why not, where they do not suffice for a registration.
    """

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
            **(_no_use(self.use) if isinstance(self.use, str) else self.use.summary()),
            "inputs": inputs_document(self.inputs),
            "files": [str(path) for path in self.files],
        }


def touch_case(context: CaseContext, out: Path, choice: Choice, seed: int) -> TouchRun:
    """Plan the touches of a case's markers for a chosen puncture, execute them in the twin, write what they read.

    Args:
        context: Of a case with declared errors, markers and an arm.

    Raises:
        InputError: The case declares no errors, or has no markers.
        NoAnswerError: Nothing is safe, or too few markers can be touched, with the reasons.
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


class TouchedOnce(NamedTuple):
    """One executed tour, and what its readings are good for, or why not."""

    touched: ExecutedTouches
    use: Use | str


def plan_tour(context: CaseContext, choice: Choice, seed: int) -> Tour:
    """Plan the touches for a chosen puncture."""
    context.require_arm()
    q_insertion, outward_ct = _puncture(context, choice)
    with context.stages.time("touch plan"):
        plan = plan_touches(context, q_insertion, seed=seed, progress=partial(context.watcher.count, "motions"))
    return Tour(plan, q_insertion, outward_ct)


def touch_once(context: CaseContext, tour: Tour, seed: int) -> TouchedOnce:
    """Execute a tour where everything truly is, by one draw of the declared errors."""
    truth = true_touches(context, tour, seed)
    checkers, count = approach_checkers(context, TOUCHING_PADDING_MM), partial(context.watcher.count, "touches")
    with context.stages.time("touches"):
        touched = execute_touches(tour.plan, context.case, context.anatomy, checkers, truth, count)
    return TouchedOnce(touched, _use(context, tour, truth, _points(touched)))


def drawn_once(context: CaseContext, tour: Tour, seed: int) -> Use | str:
    """What the same tour in the same truth is good for where every touch reads its joints exactly: no physics."""
    plan, truth = tour.plan, true_touches(context, tour, seed)
    joints = np.array([truth.q_contact(plan.model, plan.tip_mm, touch) for touch in plan.touches])
    points = np.array([nominal_tip(plan.model, plan.tip_mm, q) for q in joints])
    names = tuple(touch.name for touch in plan.touches)
    return _use(context, tour, truth, NamedPoints(names, points, None, joints=joints))


def _use(context: CaseContext, tour: Tour, truth: TouchTruth, read: NamedPoints) -> Use | str:
    """What readings are good for; in words why they do not suffice."""
    if len(read.names) < MIN_MARKERS:
        return f"{len(read.names)} of {len(tour.plan.touches)} markers were touched; {MIN_MARKERS} are needed"
    try:
        fitted = registered(context, read)
        expected = expected_of_touches(context, tour.q_insertion, read)
        return Use(fitted, expected, _tip_error(context, tour.plan, truth, fitted, tour.q_insertion))
    except InputError as error:
        return error.what
    except NoAnswerError as error:
        return str(error)


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
    """Where everything truly is: the belief is one registration that the declared errors allow."""
    errors = _true_errors(context)
    assert context.placement is not None and context.placement.registration is not None
    E = misregistered(context, tour.outward_ct, tour.q_insertion, seed)
    markers = context.placement.registration.markers
    T_base_ct = context.placement.T_base_ct @ np.linalg.inv(E)
    return draw_touch_truth(T_base_ct, markers.names, markers.points_ct, errors, seed)


def _points(touched: Touched) -> NamedPoints:
    """The readings in the order in which they were made."""
    readings = touched.readings
    points = np.array([one.point_base for one in readings]).reshape(-1, 3)
    joints = np.array([one.q for one in readings]).reshape(-1, 6)
    return NamedPoints(tuple(one.name for one in readings), points, None, joints=joints)


def _tip_error(
    context: CaseContext, plan: TouchPlan, truth: TouchTruth, fitted: Registration, q_insertion: Floats
) -> float:
    """Tip to true target of the erring arm, sent to where the new registration puts the target, mm."""
    assert context.placement is not None
    target_ct, beliefs = context.case.target_ct, (context.placement.T_base_ct, fitted.T_base_ct)
    q = registered_joints(plan.model, plan.tip_mm, q_insertion, target_ct, beliefs)
    at_target = true_at_target(context, truth.seed)
    tip = true_needle(plan.model, q + at_target.arrival, truth.eta, plan.tip_mm).tip_base
    return float(np.linalg.norm(tip - apply(truth.T_base_ct, at_target.target_ct)))


def true_at_target(context: CaseContext, seed: int) -> AtTarget:
    """What is true when the needle arrives, by one draw of the declared errors."""
    return draw_at_target(context.case.target_ct, _true_errors(context), seed)


def _true_errors(context: CaseContext) -> ErrorModel:
    """What the truth is drawn from."""
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
    """For the terminal."""
    plan, touched = run.plan, run.touched
    each = f", {_per_touch(touched):.1f} s each" if touched.readings else ""
    of = f" of {len(touched.readings) + len(touched.failed)}" if touched.failed else ""
    left = (f"{name} not touched: {why}" for name, why in (*plan.left_out.items(), *touched.failed.items()))
    head = f"{len(touched.readings)}{of} markers touched in {touched.seconds:.0f} s{each}"
    return text([Section(head, [grid(TOUCHED, run.summary()["touches"]), *left]), *_use_said(run), *footer(run.files)])


def _use_said(run: TouchRun) -> list[Section]:
    plan, use = run.plan, run.use
    if isinstance(use, str):
        return [Section(f"no registration: {use}", [])]
    failed = ", ".join(run.touched.failed)
    without = f" without {failed}, {plan.expected_mm:.2f} with them" if failed else ""
    expected = f"expected tip error: {use.expected_mm:.2f} mm rms{without}; with the worst poses {plan.worst_mm:.2f} mm"
    truth = f"error in this trial (seed {run.seed}): {use.tip_error_mm:.2f} mm; FRE {use.registration.fre_mm:.2f} mm"
    return [Section(expected, []), Section(truth, [flag.sentence for flag in use.registration.flags])]


def _per_touch(touched: Touched) -> float | None:
    """Seconds for each that was read."""
    return touched.seconds / len(touched.readings) if touched.readings else None
