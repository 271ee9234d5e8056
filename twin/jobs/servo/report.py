"""What a servo command found: one table of plain values for ``--json``, and the sections that terminal and page show.

Above, the facts: nothing else is read below. Below, each fact once: its name, its key, its digits and its unit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.planning.base.strict_json import plain
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.search.uncertainty_breakdown import chance_text
from puncture_twin.twin.guidance.stereo.robot_calibration import RobotCalibration
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.guidance.stereo.servo_law import Mapping as HeadMapping
from puncture_twin.twin.rehearsal.stereo_session import ServoTrial, declaration_test, needle_statistics
from puncture_twin.twin.report.page.template import Card
from puncture_twin.twin.report.present import (
    Block,
    Field,
    Section,
    Table,
    Warn,
    facts as facts_table,
    footer,
    grid,
    number,
    percent,
    picture,
    text,
    write_page,
)

PHASES = {"open_loop": "by mapping and robot alone", "servoed": "after the servo"}
"""By mapping and robot alone, and after the servo."""

NO_TOUCH = "not computed: the case has no structures"
"""Of ``p_touch``: which is something else than 0."""

NOT_MODELLED = "bending of the rod, cameras moved after the calibration, tissue"

DOUBTED = 0.01
"""Chance of residuals so large below which the declaration is doubted, as in the CT case."""

Facts = Mapping[str, Any]
"""What `servo_facts` returns: mm, shares 0..1."""


def servo_facts(case: ServoCase, trials: Sequence[ServoTrial], ours: Facts) -> dict[str, Any]:
    """A case's sessions, each seed and all together."""
    stops = Counter(row.stop for one in trials for row in one.targets)
    return {
        "case": case.name,
        "inputs": inputs_document(case.inputs),
        "tolerance_mm": case.file.servo.tolerance_mm,
        "estimate": case.file.servo.estimate,
        "stops": dict(stops),
        "statistics": ours,
        "sessions": [{key: value for key, value in plain(one).items() if key != "declaration"} for one in trials],
        "needle": _needle(case, trials),
    }


def _needle(case: ServoCase, trials: Sequence[ServoTrial]) -> dict[str, Any]:
    """The needle against the anatomy, predicted beside realised, over all seeds."""
    test = declaration_test(trials)
    rows = [row for one in trials for row in one.targets]
    found = {phase: needle_statistics([getattr(row, f"needle_{phase}") for row in rows]) for phase in PHASES}
    return {
        **found,
        "hit_radius_mm": case.file.target.hit_radius_mm,
        "p_touch": None,
        "p_touch_note": NO_TOUCH,
        "wrong_belief": case.wrong_belief,
        "declared": case.errors.stated(),
        "declaration": None if test is None else {**test._asdict(), "p": test.p},
    }


def recording_facts(
    case: ServoCase, folder: Path, calibration: RobotCalibration, mapping: HeadMapping, looks: Sequence[Facts]
) -> dict[str, Any]:
    """What a recorded session says; mm and degrees."""
    last = {one["target"]: one["error_mm"] for one in looks}
    within = [error_mm is not None and error_mm <= case.file.servo.tolerance_mm for error_mm in last.values()]
    return {
        "case": case.name,
        "recording": str(folder),
        "inputs": inputs_document(case.inputs),
        "tolerance_mm": case.file.servo.tolerance_mm,
        "calibration_rms_px": list(calibration.rms_px),
        "robot_residual_mm": float(np.mean(calibration.robot_residual_mm)),
        "T_base_c": calibration.T_base_c.tolist(),
        "fre_mm": mapping.fre_mm,
        "looks": list(looks),
        "converged": all(within),
    }


LOOK = (
    Field("target", "target"),
    Field("ball to target, mm", lambda row: row["lost"] or number(row["error_mm"], 3)),
    Field("needle expected (rms)", "needle_rms_mm", 2, "mm"),
    Field("chance to hit", lambda row: "" if row["p_hit"] is None else chance_text(row["p_hit"])),
)


def recording_text(facts: Facts) -> str:
    """What a recorded session says, for a terminal."""
    pixels = " and ".join(number(rms, 3) for rms in facts["calibration_rms_px"])
    rows = [
        ("cameras", f"residuals of {pixels} px (rms)"),
        ("robot to cameras", f"residual of {number(facts['robot_residual_mm'], 3, 'mm')} (mean)"),
        ("markers", f"residual of {number(facts['fre_mm'], 3, 'mm')} (rms)"),
    ]
    looks = grid(LOOK, facts["looks"])
    head = Section(f"case {facts['case']}, recorded in {facts['recording']}", [facts_table(rows)])
    return text([head, Section("every look at the ball", [looks])])


class Pictures(NamedTuple):
    """What a page shows beside the numbers."""

    convergence: Path
    cameras: Sequence[Path]


def servo_text(facts: Facts, paper: Sequence[Section] = ()) -> str:
    """The sections for a terminal, those of a paper first, then the files."""
    head = Section(f"case {facts['case']}", [])
    return text([head, *paper, *sections(facts), *footer(facts["files"])])


def write_servo_page(
    case: ServoCase, facts: Facts, pictures: Pictures, path: Path, paper: Sequence[Section] = ()
) -> Path:
    """Write ``servo.html``: the sections, and the pictures of the first seed, on one page that needs no network."""
    count = len(facts["sessions"][0]["targets"])
    title = f"{case.name}: visual servoing to {plural(count, 'target')}"
    return write_page(path, title, _setup(case), _cards(facts), [*paper, *sections(facts, pictures)], case.inputs)


def sections(facts: Facts, pictures: Pictures | None = None) -> list[Section]:
    """Everything that is shown: the first seed, all seeds, needle, calibration."""
    first = facts["sessions"][0]
    return [
        Section(f"every target of seed {first['seed']}, true errors in mm", _targets(first)),
        *(() if pictures is None else _shown(pictures)),
        Section("all seeds", [facts_table(STATISTICS, facts["statistics"])]),
        Section("the needle against the anatomy", _needle_blocks(facts["needle"], first)),
        Section("calibration", [facts_table(CALIBRATION, first), *_stereo(first)]),
    ]


def _mean_and_most(ours: Facts, name: str) -> str:
    return f"{number(ours[f'{name}_mean'], 3)} and {number(ours[f'{name}_max'], 3, 'mm')}"


TARGET = (
    Field("target", "target"),
    Field("mapping", "mapping_mm", 2),
    Field("expected", "expected_tre_mm", 2),
    Field("before", "before_mm", 2),
    Field("calibrated", "calibrated_mm", 2),
    Field("after", "after_mm", 2),
    Field("servo-only", "servo_only_mm", 3),
    Field("corrections", "steps"),
    Field("ended", lambda row: row["stop"].replace("_", " ")),
)


def _sessions(ours: Facts) -> str:
    seeds = plural(ours["seeds"], "seed")
    return seeds + f"; not possible: {plural(ours['refused'], 'session')}" * bool(ours["refused"])


STATISTICS = (
    Field("sessions", _sessions),
    Field("targets", "targets"),
    Field("stereo, mean and maximum", lambda ours: _mean_and_most(ours, "stereo")),
    Field("mapping, mean", "mapping_mean", 3, "mm"),
    Field("mapping, rms", "mapping_rms", 3, "mm"),
    Field("error expected by the mapping, rms", "expected_tre_rms", 3, "mm"),
    Field("before, mean", "before_mean", 3, "mm"),
    Field("calibrated arm without servo, mean", "calibrated_mean", 3, "mm"),
    Field("after, mean", "after_mean", 3, "mm"),
    Field("after over mapping (its floor is 1)", "after_over_mapping", 3),
    Field("servo-only, mean and maximum", lambda ours: _mean_and_most(ours, "servo_only")),
    Field("corrections, median", "median_steps", 1),
    Field("not confirmed", lambda ours: percent(ours["not_confirmed"])),
)  # fmt: skip
CALIBRATION = (
    Field("residual of each camera (rms)", lambda one: " and ".join(
        number(px, 3) for px in one["calibration_rms_px"]) + " px"),
    Field("robot against C after the rigid fit (mean)", "robot_residual_mm", 2, "mm"),
    Field("markers, residual (rms; not the accuracy at a target)", "fre_mm", 2, "mm"),
)  # fmt: skip


def _targets(first: Facts) -> list[Block]:
    if first["refused"]:
        return [Warn((f"not possible: {first['refused']}",))]
    words = (
        "mapping: estimated to true target; expected: its own estimate (rms); before: true ball to true target after "
        "the robot alone; calibrated: the same, the arm's errors estimated; after: the same after the servo; "
        "servo-only: true ball to estimated target, the part due to the servo"
    )
    return [grid(TARGET, first["targets"]), words]


def _shown(pictures: Pictures) -> list[Section]:
    convergence = picture(pictures.convergence, "Distance from ball to estimated target against corrections")
    cameras = [picture(one, one.stem) for one in pictures.cameras]
    return [Section("convergence of the servo", [convergence]), Section("through the cameras", cameras)]


def _stereo(first: Facts) -> list[Block]:
    points = first["stereo_mm"]
    if not points:
        return []
    return [f"stereo at {len(points)} points: mean {sum(points) / len(points):.3f}, max {max(points):.3f} mm"]


def _of_needle(key: str, digits: int = 2) -> Any:
    return lambda row: None if row["needle_servoed"] is None else number(row["needle_servoed"][key], digits)


NEEDLE = (
    Field("target", "target"),
    Field("expected", lambda row: "unknown" if row["needle_servoed"] is None else _of_needle("predicted_rms_mm")(row)),
    Field("95 % half axes", lambda row: (one := row["needle_servoed"]) and " x ".join(
        f"{mm:.2f}" for mm in one["half_axes_mm"])),
    Field("lateral", _of_needle("lateral_mm")),
    Field("depth", _of_needle("depth_mm")),
    Field("direction °", _of_needle("predicted_direction_deg")),
    Field("chance to hit", lambda row: (one := row["needle_servoed"]) and one["p_hit"] and chance_text(one["p_hit"])),
    Field("realised", _of_needle("realised_mm")),
)  # fmt: skip
"""Of a target's needle at the servo's last look, mm."""


def _needle_blocks(needle: Facts, first: Facts) -> list[Block]:
    """Over all seeds by each way, realised beside predicted; what must be known before; each needle of one seed."""
    radius = needle["hit_radius_mm"]
    rows = [
        ("tip error, rms, mm", *_both(needle, "realised_rms_mm", "predicted_rms_mm")),
        ("direction, rms, °", *_both(needle, "realised_direction_deg", "predicted_direction_deg")),
        ("inside the 95 % ellipsoid", *_both(needle, "coverage_95", "")),
        *([] if radius is None else [(f"hit, within {radius:g} mm", *_both(needle, "hit_share", "mean_p_hit"))]),
    ]
    warned = []
    if needle["wrong_belief"]:
        warned.append("The trials were drawn from [rehearsal.errors]: the belief is wrong by design.")
    test = needle["declaration"]
    tested = "not tested: the joint estimate does not converge"
    if test is not None:
        tested = "residuals {chi_squared:.0f} for {freedom} degrees of freedom, p = {p:.3f}".format(**test)
        if test["p"] < DOUBTED:
            warned.append(f"WARNING: {tested}: the measurements differ by more than declared")
    return [
        Table(("realised / predicted", *PHASES.values()), tuple(rows)),
        Warn(tuple(warned)),
        "The needles of one seed share its errors: the seeds are independent, the needles are not. "
        f"Declared errors: {tested}. Chance to touch: {NO_TOUCH}. Not modelled: {NOT_MODELLED}.",
        f"Each needle of seed {first['seed']} after the servo, mm; expected (rms) includes the tolerance; unknown if "
        "nothing was seen at the end, or if the measurements contradict each other:",
        grid(NEEDLE, first["targets"]),
    ]


def _both(needle: Facts, realised: str, predicted: str) -> list[str]:
    """Of each way."""
    cells = []
    for one in map(needle.__getitem__, PHASES):
        if one is None:
            cells.append("unknown")
        elif realised.endswith(("_mm", "_deg")):
            cells.append(f"{one[realised]:.3f} / {one[predicted]:.3f}")
        else:
            cells.append(f"{100 * one[realised]:.1f} / {100 * one.get(predicted, 0.95):.1f} %")
    return cells


def _setup(case: ServoCase) -> str:
    plan, robot, servo, arm = case.file.cameras, case.file.robot, case.file.servo, case.errors
    return (
        f"Two cameras of {plan.size_px[0]} x {plan.size_px[1]} px, {plan.baseline_mm:g} mm apart, "
        f"{plan.distance_mm:g} mm away, noise {plan.noise_grey:g} grey levels; centre by {plan.centre}; "
        f"{robot.model} off by {arm.link_mm:g} mm, {arm.joint_deg:g}°, play {arm.backlash_deg:g}°, "
        f"repeatability {arm.repeatability_deg:g}°; measuring arm {arm.measuring_arm_mm:g} mm an axis, "
        f"12 points over {' x '.join(f'{mm:g}' for mm in case.file.calibration.size_mm)} mm; "
        f"tolerance {servo.tolerance_mm:g} mm; "
        f"estimate: {'joint' if servo.estimate == 'joint' else 'the chain'}."
    )


def _cards(facts: Facts) -> list[Card]:
    ours, tolerance = facts["statistics"], facts["tolerance_mm"]
    ratio, most, steps = f"{ours['after_over_mapping']:.3f}", f"{ours['servo_only_max']:.3f}", ours["median_steps"]
    return [
        Card("before the servo", number(ours["before_mean"], 2, "mm"), "mean, true ball to true target"),
        Card("after the servo", number(ours["after_mean"], 2, "mm"), f"{ratio} times the mapping's"),
        Card("servo-only", number(ours["servo_only_mean"], 3, "mm"), f"mean; at most {most} mm"),
        Card("not confirmed", percent(ours["not_confirmed"]), f"within {tolerance:g} mm; median {steps:g} steps"),
    ]
