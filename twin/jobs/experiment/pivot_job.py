"""`pivot`: the needle's tip from touches of one place, that were read or are executed in the twin, beside the truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from puncture_twin.planning.arm.kinematics import PARAMETERS, check_recording, flange_pose
from puncture_twin.planning.base.arrays import Floats, rms
from puncture_twin.planning.base.errors import NoAnswerError, refuse
from puncture_twin.planning.base.files import read_input
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.provenance import Input, content_input, inputs_document
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.points import (
    MAX_FILE_BYTES,
    NamedPoints,
    parse_joint_recording,
    parse_triple,
    write_points,
)
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.touch.touch_planner import (
    LEAST_POSES,
    MOST_POSES,
    TOUCHING_PADDING_MM,
    approach_checkers,
    plan_pivot,
)
from puncture_twin.twin.guidance.ct.pivot import LARGE, Pivot, arm_covariance, check_one_place, pivot_calibration
from puncture_twin.twin.jobs.terminal import write_result
from puncture_twin.twin.report.present import Section, footer, text, vector

if TYPE_CHECKING:  # a list is read where the simulator is not installed
    from puncture_twin.twin.guidance.ct.touching import Touched

STANDS_OUT = 2.0  # a touch that misses by so many times the others' root mean square is named
PIVOT, SUMMARY = "pivot.csv", "pivot.json"


@dataclass(frozen=True, eq=False)
class PivotRun:
    """A calibrated tip beside the case's."""

    case: Case
    pivot: Pivot
    names: tuple[str, ...]
    inputs: tuple[Input, ...]

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        pivot = self.pivot
        return {
            "case": self.case.name,
            "poses": len(self.names),
            "tip_flange_mm": pivot.tip_flange.tolist(),
            "tip_sd_mm": np.sqrt(np.diag(pivot.cov_tip)).tolist(),
            "stated_length_mm": self.case.needle.length_mm,
            "residual_mm": pivot.residual_mm,
            "expected_residual_mm": pivot.expected_mm,
            "expected_residual_with_arm_mm": pivot.expected_whole_mm,
            "residual_is_large": pivot.large,
            "misses_mm": dict(zip(self.names, pivot.misses_mm.tolist(), strict=True)),
            "inputs": inputs_document(self.inputs),
        }


def refuse_twin_options(*options: object) -> None:
    """Refuse options of the twin beside touches that were read."""
    if any(option is not None for option in options):
        allowed = "JOINTS.csv, or the options of the twin"
        refuse("twin options with recorded touches", "pivot", allowed, "conflicting_options")


def pivot_case(case: Case, joints: Path) -> PivotRun:
    """Calibrate the tip from a CSV of touches of one place, a line a pose, with q1_deg to q6_deg among its columns.

    Raises InputError: The case declares no errors, or there are no joints, too few, too much alike, of several places.
    """
    data = read_input(joints, max_bytes=MAX_FILE_BYTES, where=str(joints))
    read = parse_joint_recording(data, joints, timed=False)
    check_recording(case.robot.model, case.needle.length_mm, read, where=joints)
    pivot = calibrated(case, read.names, read.q, where=str(joints))
    inputs = (content_input("joints", joints.name, data), *case.inputs)
    return PivotRun(case, pivot, read.names, inputs)


def calibrated(case: Case, names: tuple[str, ...], q: Floats, *, where: str) -> Pivot:
    """The pivot calibration of the tip from joints (n, 6), rad, that touched one place."""
    if case.errors is None:
        refuse("no noise is declared", case.path, "[errors] touch_mm", "no_noise")
    model, tip_mm = case.robot.model, case.needle.length_mm
    poses = flange_pose(model, q)
    check_one_place(names, poses[:, :3, 3] + tip_mm * poses[:, :3, 2], poses[:, :3, :3], where=where)
    arm_cov = arm_covariance(case.errors, model, tip_mm, q)
    return pivot_calibration(poses, case.errors.touch_mm, arm_cov=arm_cov, where=where)


def pivot_text(run: PivotRun) -> str:
    """Text of a calibrated tip, for the terminal."""
    return text(_pivot_said(run))


def _pivot_said(run: PivotRun) -> list[Section]:
    pivot, stated = run.pivot, run.case.needle.length_mm
    x, y, z = pivot.tip_flange
    tip, sd = vector(pivot.tip_flange, 3, "mm"), vector(np.sqrt(np.diag(pivot.cov_tip)), 3)
    said = [
        f"tip in the flange frame: {tip}, sd {sd}, from {len(run.names)} poses",
        f"the case states {stated:g} mm along z: {z - stated:+.3f} mm, and {np.hypot(x, y):.3f} mm off that axis",
        f"residual {pivot.residual_mm:.3f} mm rms; expected from the declared touch noise: {pivot.expected_mm:.3f}, "
        f"with the declared errors of the arm {pivot.expected_whole_mm:.3f}",
        *_likely_cause(run),
    ]
    return [Section(one, []) for one in said]


def _likely_cause(run: PivotRun) -> list[str]:
    pivot = run.pivot
    if not pivot.large:
        arm = pivot.expected_whole_mm > LARGE * pivot.expected_mm
        return ["most of it comes from the declared errors of the arm: more poses do not help"] if arm else []
    worst = int(np.argmax(pivot.misses_mm))
    rest = rms(np.delete(pivot.misses_mm, worst))
    head = f"the residual is more than {LARGE:g} times the declared one"
    if pivot.misses_mm[worst] > STANDS_OUT * rest:
        one = f"{run.names[worst]} misses by {pivot.misses_mm[worst]:.2f} mm, the others by {rest:.2f} (rms)"
        return [f"{head}: {one}: the tip slipped there, or touched another point"]
    return [f"{head}, in all touches alike: arm errors larger than declared, or touches of several points"]


@dataclass(frozen=True, eq=False)
class PivotTourRun:
    """An executed pivot calibration: the tip that its joints give, and the true one (3,); the place planned; mm."""

    calibration: PivotRun
    seed: int
    place_base: Floats  # shape (3,), mm: the place as it was planned
    true_tip_flange: Floats  # shape (3,), mm
    touched: Touched
    files: tuple[Path, ...]

    @property
    def error_mm(self) -> float:
        """Distance of the calibrated tip from the true one."""
        return float(np.linalg.norm(self.calibration.pivot.tip_flange - self.true_tip_flange))

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON; the expected error is the rms by the declared errors."""
        return {
            **self.calibration.summary(),
            "seed": self.seed,
            "place_mm": self.place_base.tolist(),
            "true_tip_flange_mm": self.true_tip_flange.tolist(),
            "tip_error_mm": self.error_mm,
            "expected_tip_error_mm": float(np.sqrt(np.trace(self.calibration.pivot.cov_tip))),
            "failed": dict(self.touched.failed),
            "seconds": self.touched.seconds,
            "files": [str(path) for path in self.files],
        }


def parse_place(text: str | None) -> Floats | None:
    """A place in the base frame, mm, as it is typed; refused where it is not three numbers."""
    return None if text is None else np.array(parse_triple(text, "--at", "X,Y,Z in mm, in the robot's base frame"))


def pivot_tour(context: CaseContext, out: Path, poses: int, place_base: Floats | None, seed: int) -> PivotTourRun:
    """Plan a pivot calibration about a place (3,), mm, or one that is found, execute it in the twin, write its result.

    Raises InputError: No declared errors, no arm, or too few or many poses. NoAnswerError: No place can be touched in
    so many, or too few were touched.
    """
    case = context.case
    if not LEAST_POSES <= poses <= MOST_POSES:
        refuse(f"{poses} poses", "--poses", f"{LEAST_POSES} to {MOST_POSES}", "out_of_range")
    if case.errors is None:
        refuse("no noise is declared", case.path, "[errors] touch_mm", "no_noise")
    from puncture_twin.twin.plant.touching import execute_touches
    from puncture_twin.twin.plant.true_needle import draw_pivot_truth

    with writing(out, "pivot", inputs=case.inputs, names=(PIVOT, SUMMARY), note=context.watcher.note) as draft:
        with context.stages.time("pivot plan"):
            count = partial(context.watcher.count, "motions")
            tour = plan_pivot(context, poses, place_base=place_base, seed=seed, progress=count)
        errors, place = case.truth_errors or case.errors, tour.touches[0].point_base
        truth = draw_pivot_truth(
            context.require_arm().T_base_ct, tuple(f"P{k + 1}" for k in range(len(tour.touches))), place, errors, seed
        )
        checkers, count = approach_checkers(context, TOUCHING_PADDING_MM), partial(context.watcher.count, "touches")
        with context.stages.time("touches"):
            touched = execute_touches(tour, case, context.anatomy, checkers, truth, count)
        if len(touched.readings) < LEAST_POSES:
            why = "; ".join(f"{name}: {reason}" for name, reason in touched.failed.items())
            what = f"{len(touched.readings)} of {len(tour.touches)} poses were touched; {LEAST_POSES} are needed: {why}"
            raise NoAnswerError(what, code="too_few_poses")
        names, joints = tuple(one.name for one in touched.readings), np.array([one.q for one in touched.readings])
        calibration = PivotRun(case, calibrated(case, names, joints, where=str(case.path)), names, case.inputs)
        true_tip = truth.eta[PARAMETERS["tip_offset"]] + np.array([0.0, 0.0, tour.tip_mm])
        files = draft.final((draft.folder / PIVOT, draft.folder / SUMMARY))
        run = PivotTourRun(calibration, seed, place, true_tip, touched, files)
        points = np.array([one.point_base for one in touched.readings])
        write_points(draft.folder / PIVOT, NamedPoints(names, points, None, joints=joints))
        write_result(run.summary(), draft.folder / SUMMARY, out)
    return run


def pivot_tour_text(run: PivotTourRun) -> str:
    """Text of an executed pivot calibration, for the terminal."""
    expected = float(np.sqrt(np.trace(run.calibration.pivot.cov_tip)))
    at, count, seconds = vector(run.place_base, 0, "mm"), len(run.touched.readings), run.touched.seconds
    failed = [f"{name} not touched: {why}" for name, why in run.touched.failed.items()]
    off = f"error {run.error_mm:.3f} mm, expected {expected:.3f} mm (rms)"
    true = f"the true tip (seed {run.seed}) is {vector(run.true_tip_flange, 3, 'mm')}: {off}"
    head = Section(f"{count} poses touched about {at} (base) in {seconds:.0f} s", failed)
    return text([head, *_pivot_said(run.calibration), Section(true, []), *footer(run.files)])
