"""The command ``servo``: a servo case, or a recorded session, from file to facts, sections, pictures and page."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import new_folder
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.progress import Count, uncounted
from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.planning.base.strict_json import plain
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.search.uncertainty_breakdown import chance_text
from puncture_twin.twin.guidance.stereo.ball import image_detector
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase, load_servo_case
from puncture_twin.twin.guidance.stereo.servo_law import Posture
from puncture_twin.twin.guidance.stereo.session import calibrate_by_robot, follow, map_markers, read_recording
from puncture_twin.twin.jobs.servo.pictures import draw_cameras, draw_convergence
from puncture_twin.twin.jobs.terminal import Answer
from puncture_twin.twin.rehearsal import stereo_session
from puncture_twin.twin.report import present
from puncture_twin.twin.report.present import Block, Card, Field, Section, Table, Warn, grid, number, percent

PHASES = {"open_loop": "by mapping and robot alone", "servoed": "after the servo"}
NO_TOUCH = "not computed: the case has no structures"  # of ``p_touch``: which is something else than 0
NOT_MODELLED = "bending of the rod, cameras moved after the calibration, tissue"
DOUBTED = 0.01  # chance of residuals so large below which the declaration is doubted, as in the CT case
Facts = Mapping[str, Any]  # what `servo_facts` returns: mm, shares 0..1
NAMES = ("servo.html", "convergence.png", "camera_1.png", "camera_2.png")


def servo_facts(case: ServoCase, trials: Sequence[stereo_session.ServoTrial], ours: Facts) -> dict[str, Any]:
    """A case's sessions, each seed and all together, and the needle against the anatomy, predicted beside realised."""
    test, rows = stereo_session.declaration_test(trials), [row for one in trials for row in one.targets]
    needles = {
        phase: stereo_session.needle_statistics([getattr(row, f"needle_{phase}") for row in rows]) for phase in PHASES
    }
    return {
        "case": case.name,
        "inputs": inputs_document(case.inputs),
        "tolerance_mm": case.file.servo.tolerance_mm,
        "estimate": case.file.servo.estimate,
        "stops": dict(Counter(row.stop for row in rows)),
        "statistics": ours,
        "sessions": [{key: value for key, value in plain(one).items() if key != "declaration"} for one in trials],
        "needle": {
            **needles,
            "hit_radius_mm": case.file.target.hit_radius_mm,
            "p_touch": None,
            "p_touch_note": NO_TOUCH,
            "wrong_belief": case.wrong_belief,
            "declared": case.errors.stated(),
            "declaration": None if test is None else {**test._asdict(), "p": test.p},
        },
    }


LOOK = (
    Field("target", "target"),
    Field("ball to target, mm", lambda row: row["lost"] or number(row["error_mm"], 3)),
    Field("needle expected (rms)", "needle_rms_mm", 2, "mm"),
    Field("chance to hit", lambda row: "" if row["p_hit"] is None else chance_text(row["p_hit"])),
)


def recording_text(facts: Facts) -> str:
    """Text of a recorded session."""
    pixels = " and ".join(number(rms, 3) for rms in facts["calibration_rms_px"])
    rows = [
        ("cameras", f"residuals of {pixels} px (rms)"),
        ("robot to cameras", f"residual of {number(facts['robot_residual_mm'], 3, 'mm')} (mean)"),
        ("markers", f"residual of {number(facts['fre_mm'], 3, 'mm')} (rms)"),
    ]
    looks = grid(LOOK, facts["looks"])
    head = Section(f"case {facts['case']}, recorded in {facts['recording']}", [present.facts(rows)])
    return present.text([head, Section("every look at the ball", [looks])])


def servo_text(facts: Facts, paper: Sequence[Section] = ()) -> str:
    """The sections for a terminal, those of a paper first, then the files."""
    head = Section(f"case {facts['case']}", [])
    return present.text([head, *paper, *sections(facts), *present.footer(facts["files"])])


def write_servo_page(
    case: ServoCase, facts: Facts, pictures: Sequence[Path], path: Path, paper: Sequence[Section] = ()
) -> Path:
    """Write ``servo.html``: the sections, and the pictures of the first seed, on one page that needs no network."""
    plan, robot, servo, arm = case.file.cameras, case.file.robot, case.file.servo, case.errors
    setup = (
        f"Two cameras of {plan.size_px[0]} x {plan.size_px[1]} px, {plan.baseline_mm:g} mm apart, "
        f"{plan.distance_mm:g} mm away, noise {plan.noise_grey:g} grey levels; centre by {plan.centre}; "
        f"{robot.model} off by {arm.link_mm:g} mm, {arm.joint_deg:g}°, play {arm.backlash_deg:g}°, "
        f"repeatability {arm.repeatability_deg:g}°; measuring arm {arm.measuring_arm_mm:g} mm an axis, "
        f"12 points over {' x '.join(f'{mm:g}' for mm in case.file.calibration.size_mm)} mm; "
        f"tolerance {servo.tolerance_mm:g} mm; "
        f"estimate: {'joint' if servo.estimate == 'joint' else 'the chain'}."
    )
    title = f"{case.name}: visual servoing to {plural(len(facts['sessions'][0]['targets']), 'target')}"
    return present.write_page(path, title, setup, _cards(facts), [*paper, *sections(facts, pictures)], case.inputs)


def sections(facts: Facts, pictures: Sequence[Path] = ()) -> list[Section]:
    """Sections of the sessions: the first seed, all seeds, needle, calibration; pictures of convergence and cameras."""
    first, shown = facts["sessions"][0], list[Section]()
    if pictures:
        plot = present.picture(pictures[0], "Distance from ball to estimated target against corrections")
        cameras = [present.picture(one, one.stem) for one in pictures[1:]]
        shown = [Section("convergence of the servo", [plot]), Section("through the cameras", cameras)]
    targets: list[Block] = [Warn((f"not possible: {first['refused']}",))]
    if not first["refused"]:
        targets = [grid(TARGET, first["targets"]), ABOUT_TARGETS]
    stereo: list[Block] = []
    if points := first["stereo_mm"]:
        mean, most = sum(points) / len(points), max(points)
        stereo.append(f"stereo at {len(points)} points: mean {mean:.3f}, max {most:.3f} mm")
    return [
        Section(f"every target of seed {first['seed']}, true errors in mm", targets),
        *shown,
        Section("all seeds", [present.facts(STATISTICS, facts["statistics"])]),
        Section("the needle against the anatomy", _needle_blocks(facts["needle"], first)),
        Section("calibration", [present.facts(CALIBRATION, first), *stereo]),
    ]


def _mean_and_most(ours: Facts, name: str) -> str:
    return f"{number(ours[f'{name}_mean'], 3)} and {number(ours[f'{name}_max'], 3, 'mm')}"


ABOUT_TARGETS = (
    "mapping: estimated to true target; expected: its own estimate (rms); before: true ball to true target after "
    "the robot alone; calibrated: the same, the arm's errors estimated; after: the same after the servo; "
    "servo-only: true ball to estimated target, the part due to the servo"
)
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


def _of_needle(key: str) -> Any:
    return lambda row: None if row["needle_servoed"] is None else number(row["needle_servoed"][key], 2)


NEEDLE = (  # of a target's needle at the servo's last look, mm
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


def _needle_blocks(needle: Facts, first: Facts) -> list[Block]:
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
    cells = []
    for one in map(needle.__getitem__, PHASES):
        if one is None:
            cells.append("unknown")
        elif realised.endswith(("_mm", "_deg")):
            cells.append(f"{one[realised]:.3f} / {one[predicted]:.3f}")
        else:
            cells.append(f"{100 * one[realised]:.1f} / {100 * one.get(predicted, 0.95):.1f} %")
    return cells


def _cards(facts: Facts) -> list[Card]:
    ours, tolerance = facts["statistics"], facts["tolerance_mm"]
    ratio, most, steps = f"{ours['after_over_mapping']:.3f}", f"{ours['servo_only_max']:.3f}", ours["median_steps"]
    return [
        Card("before the servo", number(ours["before_mean"], 2, "mm"), "mean, true ball to true target"),
        Card("after the servo", number(ours["after_mean"], 2, "mm"), f"{ratio} times the mapping's"),
        Card("servo-only", number(ours["servo_only_mean"], 3, "mm"), f"mean; at most {most} mm"),
        Card("not confirmed", percent(ours["not_confirmed"]), f"within {tolerance:g} mm; median {steps:g} steps"),
    ]


class Sessions(NamedTuple):
    """A case's sessions: that of the first seed in full, the trial of every seed, and the statistics over all."""

    case: ServoCase
    first: stereo_session.Session
    trials: tuple[stereo_session.ServoTrial, ...]
    ours: dict[str, Any]


def run_sessions(case: ServoCase, seeds: int, done: Count = uncounted, record: Path | None = None) -> Sessions:
    """Run the sessions of a case, from its own seed on; all readings of the first one's devices go into ``record``."""
    seed = case.file.seed
    first = stereo_session.run_session(case, seed, record=record)
    done(1, seeds)
    others = stereo_session.run_trials(case, range(seed + 1, seed + seeds), lambda at, of: done(at + 1, seeds))
    trials = (first.trial, *others)
    return Sessions(case, first, trials, stereo_session.statistics(trials))


def run_servo(
    path: Path, out_dir: Path, seeds: int, done: Count, note: Callable[[str], None] | None, record: Path | None
) -> Answer:
    """Run the sessions of a case, write pictures, plot and page, and the readings of the first one into ``record``.

    Raises InputError: The case cannot be used. NoAnswerError: The first session could not be held.
    """
    case = load_servo_case(path)
    with writing(out_dir, "servo", inputs=case.inputs, names=NAMES, note=note) as draft:
        with new_folder(record) as record_folder:
            held = run_sessions(case, seeds, done, record_folder)
        facts = servo_facts(case, held.trials, held.ours)
        written = session_files(held, facts, draft.folder)
    facts["files"] = [str(path) for path in draft.final(written)]
    passed = held.ours["not_confirmed"] == 0.0 and held.ours["refused"] == 0
    return Answer(passed, facts, servo_text(facts))


def refuse_with_recording(out_dir: Path | None, record: Path | None, seeds: int) -> None:
    """Refuse options that draw or write beside a recorded session, which is only read."""
    if out_dir is not None or record is not None or seeds != 1:
        refuse("--out, --record and --seeds", "servo --recording", "--recording FOLDER alone", "conflicting_options")


def follow_recording(path: Path, recording: Path) -> Answer:
    """Calibrate and map from a recorded session, and evaluate each of its looks at the ball.

    Raises InputError: Case or recording cannot be used. NoAnswerError: A point or a marker is not found in its
    pictures.
    """
    case = load_servo_case(path)
    replay = read_recording(recording, case.file.cameras.size_px)
    unknown = {name for name, _ in replay.stops} - set(case.targets.names)
    if unknown:
        allowed = ", ".join(case.targets.names)
        refuse(f"target {', '.join(sorted(unknown))}", recording / "stops.csv", allowed, "no_target")
    detector = image_detector(replay, hough_only=case.hough_only)
    calibration = calibrate_by_robot(case, Posture(replay.q_points, -1), replay, replay, detector)
    reading = replay.reading(case.markers, case.targets)
    guide = map_markers(case, calibration, detector, replay, reading)
    looks = list(follow(case, guide, calibration.T_base_c, reading.targets_m, replay.stops, replay))
    tolerance_mm, last = case.file.servo.tolerance_mm, {one["target"]: one["error_mm"] for one in looks}
    facts: dict[str, Any] = {
        "case": case.name,
        "recording": str(recording),
        "inputs": inputs_document(case.inputs),
        "tolerance_mm": tolerance_mm,
        "calibration_rms_px": list(calibration.rms_px),
        "robot_residual_mm": float(np.mean(calibration.robot_residual_mm)),
        "T_base_c": calibration.T_base_c.tolist(),
        "fre_mm": guide.mapping.fre_mm,
        "looks": looks,
        "converged": all(error_mm is not None and error_mm <= tolerance_mm for error_mm in last.values()),
    }
    return Answer(facts["converged"], facts, recording_text(facts))


def session_files(held: Sessions, facts: Facts, out_dir: Path, paper: Sequence[Section] = ()) -> list[Path]:
    """Write pictures, plot and page of the first session; returns the paths."""
    pictures = [out_dir / "convergence.png", *draw_cameras(held.first, out_dir)]
    draw_convergence(held.first, pictures[0])
    return [write_servo_page(held.case, facts, pictures, out_dir / "servo.html", paper), *pictures]
