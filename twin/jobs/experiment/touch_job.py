"""Markers touched in the twin: planned, executed where everything truly is, written as `registration` reads them."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose, inverse, nearest_within_limits
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.formats.points.point_files import NamedPoints, write_points
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.registration import Registration
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.selection.choice import Choice, choose, chosen_angles
from puncture_twin.planning.touch.touch_plan import TouchPlan
from puncture_twin.planning.touch.touch_planner import (
    TOUCHING_PADDING_MM,
    approach_checkers,
    plan_touches,
    registered,
)
from puncture_twin.twin.plant.touch_truth import TouchTruth, draw_touch_truth
from puncture_twin.twin.plant.true_needle import true_needle
from puncture_twin.twin.rehearsal.distribution import misregistered
from puncture_twin.twin.rehearsal.touching import Touched, execute_touches

TOUCH, SUMMARY = "touch.csv", "touch.json"


@dataclass(frozen=True, eq=False)
class TouchRun:
    """What was planned, what was read, and what it is good for.

    Attributes:
        case_name: The case.
        inputs: Every file that decided.
        seed: Of the truth.
        plan: The tour.
        touched: Its readings.
        registration: Of the readings.
        tip_error_mm: Where the erring arm, sent to the target by that registration, puts its tip.
        files: Written.
    """

    case_name: str
    inputs: tuple[Input, ...]
    seed: int
    plan: TouchPlan
    touched: Touched
    registration: Registration
    tip_error_mm: float
    files: tuple[Path, ...] = ()

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
                    "bias_mm": one.bias_mm,
                    "speed_mm_s": one.speed_mm_s,
                    "aside_mm": one.aside_mm,
                }
                for one in self.touched.readings
            ],
            "left_out": dict(self.plan.left_out),
            "seconds": self.touched.seconds,
            "seconds_per_touch": self.touched.seconds / len(self.touched.readings),
            "expected_tip_error_mm": self.plan.expected_mm,
            "expected_of_worst_poses_mm": self.plan.worst_mm,
            "tip_error_mm": self.tip_error_mm,
            "fre_mm": self.registration.fre_mm,
            "inputs": inputs_document(self.inputs),
            "files": [str(path) for path in self.files],
        }


def touch_case(context: CaseContext, out: Path, choice: Choice, seed: int) -> TouchRun:
    """Plan the touches of a case's markers for a chosen puncture, execute them in the twin, write what they read.

    Args:
        context: Of a case with declared errors, markers and an arm.
        out: The output folder.
        choice: Of the puncture that the touches are for.
        seed: Of the motions and of the truth.

    Raises:
        InputError: The case declares no errors, or has no markers.
        NoAnswerError: Nothing is safe, too few markers can be touched, or a touch stopped, with the reason.
    """
    with writing(out, "touch", inputs=context.case.inputs, names=(TOUCH, SUMMARY), note=context.watcher.note) as draft:
        planned = plan_tour(context, choice, seed)
        touched, read, fitted, error = touch_once(context, planned, seed)
        plan = planned.plan
        files = draft.final((draft.folder / TOUCH, draft.folder / SUMMARY))
        run = TouchRun(context.case.name, context.case.inputs, seed, plan, touched, fitted, error, files)
        write_points(draft.folder / TOUCH, read)
        with atomic(draft.folder / SUMMARY) as temporary:
            temporary.write_text(json.dumps(run.summary(), indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return run


class Tour(NamedTuple):
    """A tour of the markers and the puncture that it is for: joints (6,), rad, and its direction outward (3,)."""

    plan: TouchPlan
    q_insertion: Floats
    outward_ct: Floats


class TouchedOnce(NamedTuple):
    """One executed tour: its readings, as points, what they register, and what the tip misses the target by, mm."""

    touched: Touched
    read: NamedPoints
    registration: Registration
    tip_error_mm: float


def plan_tour(context: CaseContext, choice: Choice, seed: int) -> Tour:
    """Plan the touches for a chosen puncture.

    Raises:
        InputError, NoAnswerError: See `touch_case`.
    """
    q_insertion, outward_ct = _puncture(context, choice)
    with context.stages.time("touch plan"):
        plan = plan_touches(context, q_insertion, seed=seed, progress=partial(context.watcher.count, "motions"))
    return Tour(plan, q_insertion, outward_ct)


def touch_once(context: CaseContext, tour: Tour, seed: int) -> TouchedOnce:
    """Execute a tour where everything truly is, by one draw of the declared errors.

    Raises:
        NoAnswerError: A touch stopped, with the reason.
    """
    plan, q_insertion = tour.plan, tour.q_insertion
    truth = _truth(context, tour.outward_ct, q_insertion, seed)
    checkers, count = approach_checkers(context, TOUCHING_PADDING_MM), partial(context.watcher.count, "touches")
    with context.stages.time("touches"):
        touched = execute_touches(plan, context.case, context.anatomy, checkers, truth, count)
    read = _by_name(plan, touched)
    fitted = registered(context, read)
    return TouchedOnce(touched, read, fitted, _tip_error(context, plan, truth, fitted, q_insertion))


def _puncture(context: CaseContext, choice: Choice) -> tuple[Floats, Floats]:
    """Joints (6,) with the tip on the target, and the direction outward (3,), of the best candidate of a choice."""
    with context.stages.time("search"):
        found = context.search() if choice.of_grid else context.check(*chosen_angles(context.case, choice))
        chosen = choose(context, found, choice)
    rows = [row for row in chosen.rows if np.isfinite(chosen.candidates.arm.q_insertion[row]).all()]
    if not rows:
        raise NoAnswerError("the arm reaches no such candidate: nothing to touch the markers for")
    return chosen.candidates.arm.q_insertion[rows[0]], chosen.candidates.outward_ct[rows[0]]


def _truth(context: CaseContext, outward_ct: Floats, q_insertion: Floats, seed: int) -> TouchTruth:
    """Where everything truly is: the belief is one registration that the declared errors allow."""
    errors = _true_errors(context)
    assert context.placement is not None and context.placement.registration is not None
    E = misregistered(context, outward_ct, q_insertion, seed)
    markers = context.placement.registration.markers
    T_base_ct = context.placement.T_base_ct @ np.linalg.inv(E)
    return draw_touch_truth(T_base_ct, markers.names, markers.points_ct, errors, seed)


def _by_name(plan: TouchPlan, touched: Touched) -> NamedPoints:
    """The readings in the order in which they were made."""
    readings = touched.readings
    points, joints = np.array([one.point_base for one in readings]), np.array([one.q for one in readings])
    return NamedPoints(tuple(one.name for one in readings), points, None, joints=joints)


def _tip_error(
    context: CaseContext, plan: TouchPlan, truth: TouchTruth, fitted: Registration, q_insertion: Floats
) -> float:
    """Tip to true target of the erring arm, sent to where the new registration puts the target, mm.

    The target was read with an error of its own, the joints drifted since the touches, and arrive with their own.
    """
    target_ct = context.case.target_ct
    T = flange_pose(plan.model, q_insertion)
    T[:3, 3] = apply(fitted.T_base_ct, target_ct) - plan.tip_mm * T[:3, 2]
    every = nearest_within_limits(plan.model, inverse(plan.model, T)[0], q_insertion)
    away = np.abs(every - q_insertion).max(axis=1)
    q = every[int(np.argmin(np.where(np.isnan(away), np.inf, away)))]
    errors, rng = _true_errors(context), np.random.default_rng([truth.seed, 2])
    arrival = rng.normal(size=6) * np.hypot(errors.arm.repeatability, errors.arm.drift)
    values, axes = np.linalg.eigh(errors.target_cov_ct)
    true_target_ct = target_ct + axes @ (rng.normal(size=3) * np.sqrt(np.maximum(values, 0.0)))
    tip = true_needle(plan.model, q + arrival, truth.eta, plan.tip_mm).tip_base
    return float(np.linalg.norm(tip - apply(truth.T_base_ct, true_target_ct)))


def _true_errors(context: CaseContext) -> ErrorModel:
    """What the truth is drawn from."""
    errors = context.case.truth_errors or context.case.errors
    assert errors is not None
    return errors


def touch_text(run: TouchRun) -> str:
    """For the terminal."""
    plan, touched = run.plan, run.touched
    lines = [f"{len(touched.readings)} markers touched in {touched.seconds:.0f} s, {_per_touch(run):.1f} s each"]
    lines += [
        f"  {one.name:<12} {one.seconds:5.1f} s  felt {one.bias_mm:.3f} mm deep at {one.speed_mm_s:.1f} mm/s, "
        f"{one.force_n:.2f} N at most; line moved {one.aside_mm:.1f} mm at the standoff"
        for one in touched.readings
    ]
    lines += [f"  {name:<12} not touched: {why}" for name, why in plan.left_out.items()]
    lines += [
        f"expected error at the target: {plan.expected_mm:.2f} mm rms; of the worst poses {plan.worst_mm:.2f} mm",
        f"error of this truth (seed {run.seed}): {run.tip_error_mm:.2f} mm; FRE {run.registration.fre_mm:.2f} mm",
        *(f"wrote {path}" for path in run.files),
    ]
    return "\n".join(lines)


def _per_touch(run: TouchRun) -> float:
    return run.touched.seconds / len(run.touched.readings)
