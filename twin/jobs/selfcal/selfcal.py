"""The command ``selfcal``: in the twin, or from a recording, to files and the sections that show what was found."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from puncture_twin.planning.base.errors import PlanningError, refuse
from puncture_twin.planning.base.files import new_folder
from puncture_twin.planning.base.output.output_set import withdraw, writing
from puncture_twin.planning.base.progress import Stages, Watcher
from puncture_twin.planning.base.provenance import Input, inputs_document
from puncture_twin.twin.guidance.ultrasound import pose_choice, recording_file
from puncture_twin.twin.guidance.ultrasound.acquisition import Acquisition, choice_noise, keep_pictures
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration, Shot, ShotByShot
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase, load_selfcal_case
from puncture_twin.twin.jobs.selfcal.pictures import detection_sheet, workcell_picture
from puncture_twin.twin.jobs.terminal import write_json
from puncture_twin.twin.rehearsal import selfcal_trial
from puncture_twin.twin.report import present
from puncture_twin.twin.report.figures import png
from puncture_twin.twin.report.present import Block, Card, Field, Section, Table, Warn, grid, number

NO_JOINTS = "{file}: no joints (columns A_q1_deg to B_q6_deg): the declared arm errors of the case are not counted"
MOST_MISSED = "{file}: no needle in {missed} pictures, and one in {shown}: is the display that of the case's machine?"
RANDOM_SETS = 50  # random choices that the informative one is compared with
PARAMETERS = "w: a small rotation, R exp([w]×); t: a shift; V: the needle’s direction."
EQUATION = "A X p = Y B q: X probe flange to image, Y base 1 to base 2, q the tip in the needle's flange frame."
RESIDUALS = (
    "Y B q − A X p of every pose, in the axes of the image. Small residuals do not prove a small error at a target."
)
COLOURS = ("#0072b2", "#e69f00", "#009e73")  # Okabe and Ito's blue, orange, green
SET_ASIDE = "#d6001e"


@dataclass(frozen=True, eq=False)
class SelfcalRun:
    """A self-calibration and its results."""

    name: str
    calibration: Calibration
    recording: Recording
    inputs: tuple[Input, ...]
    trials: tuple[selfcal_trial.SelfcalTrial, ...] = ()  # in the twin, one per seed; empty for a recording
    case: SelfcalCase | None = None
    candidates: pose_choice.CandidatePoses | None = None
    choice: dict[str, Any] | None = None
    stages: Stages = field(default_factory=Stages)
    files: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()  # what the recording leaves open, one sentence each
    shots: tuple[Shot, ...] = ()  # what came of each shot after the recording

    @property
    def punctures(self) -> tuple[selfcal_trial.Puncture, ...]:
        """The punctures of all seeds."""
        return tuple(one for trial in self.trials for one in trial.punctures)


def selfcal_twin(case: SelfcalCase, seeds: int, watcher: Watcher) -> SelfcalRun:
    """Draw ``seeds`` ground truths from the case's seed on; record, calibrate and puncture in each.

    Raises Degenerate: The poses cannot show every unknown. NoAnswerError: Too few can be taken or show the needle.
    """
    stages, seed = Stages(), case.content.seed
    with stages.time("room"):
        workcell = pose_choice.TwoArms(case)
    with stages.time("candidates"):
        candidates = pose_choice.find_candidates(case, workcell, np.random.default_rng(seed))
    trials = tuple(selfcal_trial.run_trial(case, workcell, candidates, seed + k, stages, watcher) for k in range(seeds))
    first = trials[0]
    with stages.time("comparison with random choice"):
        choice = compare_choice(case, candidates, first.acquisition)
    name, fit, recording = case.content.name, first.calibration, first.acquisition.recording
    return SelfcalRun(
        name, fit, recording, case.inputs, trials, case, candidates, choice, stages, warnings=fit.warnings()
    )


def selfcal_recording(path: Path, case: SelfcalCase | None, shots: Path | None = None) -> SelfcalRun:
    """Calibrate from a recording's CSV, or a folder with ``recording.csv``; a case says noise and needle length.

    Each pose of ``shots``, what was seen afterwards, updates the calibration. Raises InputError: A recording that
    cannot be used, or that fits only in another reading (inverse, swapped, metres). Degenerate: It cannot show every
    unknown.
    """
    file = recording_file.recording_file(path)
    stages = Stages()
    with stages.time("read"):
        recording, inputs, warnings = recording_file.open_recording(path, case)
    with stages.time("calibrate"):
        calibration = recording_file.checked_calibration(recording, case, file, hold=shots is None)
    applied: tuple[Shot, ...] = ()
    if shots is not None:
        with stages.time("shots"):
            following = ShotByShot.of(calibration)
            more, files, notes = recording_file.open_recording(shots, case)
            for row in range(len(more)):
                following = following.with_shot(more.subset(slice(row, row + 1)))
            calibration = following.calibration(needle_length_mm=recording_file.held_length_mm(case))
        applied, inputs, warnings = following.shots, (*inputs, *files), (*warnings, *notes)
    inputs = (*inputs, *(() if case is None else case.inputs))
    warnings = (*warnings, *calibration.warnings())
    if len(recording.missed) > len(recording):
        warnings += (MOST_MISSED.format(file=file.name, missed=len(recording.missed), shown=len(recording)),)
    if case is not None and calibration.arms is None:
        warnings += (NO_JOINTS.format(file=file.name),)
    return SelfcalRun(
        file.stem, calibration, recording, inputs, case=case, stages=stages, warnings=warnings, shots=applied
    )


def compare_choice(case: SelfcalCase, candidates: pose_choice.CandidatePoses, taken: Acquisition) -> dict[str, Any]:
    """The gain by choosing poses: Cramer-Rao bounds over all candidates of those recorded and of random ones, mm."""
    poses, rows = candidates.poses, [shot.candidate for shot in taken.shots]
    rng = np.random.default_rng(case.content.seed)
    sets = [np.array(rows), *(rng.choice(len(poses), len(rows), replace=False) for _ in range(RANDOM_SETS))]
    known = choice_noise(case), pose_choice.drawing(case), poses, case.declared_arms
    chosen, *random = (pose_choice.expected_tre_mm(poses.subset(some), *known) for some in sets)
    return {
        "chosen_bound_mm": chosen,
        "random_bound_median_mm": float(np.median(random)),
        "random_bound_best_mm": min(random),
        "random_sets": len(random),
    }


def calibration_summary(calibration: Calibration, recording: Recording) -> dict[str, Any]:
    """A calibration's main values, mm and degrees: with the stated noise, or the estimated spread; arms if declared."""
    names, arms = {"inside_mm": "inside_image_mm", "across_mm": "across_image_mm"}, None
    noise = {names.get(key, key): value for key, value in calibration.noise._asdict().items()}
    if calibration.arms is not None:
        arms = {
            "found_sd": calibration.arm_errors.tolist(),
            "chi2_per_freedom": calibration.chi_squared_ratio,
            "chi2_chance": calibration.chi_squared_chance(),
        }
    return {
        "T_end1_image": calibration.X.tolist(),
        "T_base1_base2": calibration.Y.tolist(),
        "tip_end2_mm": calibration.tip_end2.tolist(),
        "needle_direction_end2": calibration.needle_direction_end2.tolist(),
        "scale_mm": calibration.scale.tolist() if recording.pixels else None,
        "poses": len(recording),
        "residual_rms_mm": calibration.rms_mm,
        "set_aside": list(calibration.outliers),
        "without_needle": dict(recording.missed),
        "findings": [one.document() for one in calibration.findings],
        "iterations": calibration.iterations,
        "condition": calibration.condition,
        "noise": in_degrees(noise),
        "predicted_tre_mm": pose_choice.predicted_tre(calibration, recording),
        "tip_bias_mm": calibration.tip_bias_mm,
        "arms": arms,
        "cannot_show": list(calibration.cannot_show),
    }


def in_degrees(values: Mapping[str, float]) -> dict[str, float]:
    """The values by their names, those in rad as degrees."""
    return {
        key.replace("_rad", "_deg"): float(np.degrees(value)) if key.endswith("_rad") else value
        for key, value in values.items()
    }


Facts = Mapping[str, Any]  # what `selfcal_facts` returns: mm and degrees

REASON_TEXT: Mapping[str, str] = {  # for which a drawn pose is not taken
    "ok": "can be taken",
    "tip_outside_phantom": "tip outside the phantom",
    "probe_out_of_reach": "probe arm cannot reach",
    "needle_out_of_reach": "needle arm cannot reach",
    "probe_arm_collision": "probe arm would touch itself, the table or the phantom",
    "needle_arm_collision": "needle arm would touch itself, the table or (except with the needle) the phantom",
    "arms_collide": "the arms, or probe and needle, would touch",
}

NOISE_TEXT: Mapping[str, str] = {
    "robot_mm": "stated noise of each flange, mm per axis",
    "robot_deg": "stated noise of each flange, ° per axis",
    "image_mm": "stated noise of the tip in the image, mm per axis",
    "off_plane_mm": "stated deviation of the tip from the slice, mm",
    "direction_deg": "noise of the direction in the image, °",
    "inside_image_mm": "spread of the residuals in the image, mm per axis",
    "across_image_mm": "spread of the residuals across the slice, mm",
}
HELD_OUT = "Held-out: predicted minus true tip at poses that were not recorded, with the remaining errors of the arms."
ANSWERS = ("calibration.json", "report.html")
PICTURES = ("bmode.png", "room.png")
VERSION = 2  # of ``calibration.json``. 2: ``inputs`` lists each file with its role


def run_selfcal(
    case_path: Path | None,
    recording: Path | None,
    seeds: int,
    out: Path,
    watcher: Watcher,
    record: Path | None = None,
    shots: Path | None = None,
) -> SelfcalRun:
    """Simulate a case, or calibrate a recording, and write everything into a folder; raises what these raise.

    The first seed's pictures and joints go into the folder ``record``, which is not there yet.
    """
    if (recording is not None and record is not None) or (recording is None and shots is not None):
        allowed = "--record without --recording, and --shots with it"
        refuse("--record or --shots", "selfcal", allowed, "conflicting_options")
    case = None if case_path is None else load_selfcal_case(case_path)
    names = ANSWERS if recording is not None else (*ANSWERS, *PICTURES, recording_file.FILE_NAME)
    try:
        with new_folder(record) as record_folder, writing(out, "selfcal", names=names, note=watcher.note) as draft:
            if recording is not None:
                run = selfcal_recording(recording, case, shots)
                draft.keep(recording_file.FILE_NAME)  # one that an earlier run wrote into the folder may be this one
                files = [write_json(calibration_file(run), draft.folder / ANSWERS[0])]
            else:
                assert case is not None  # the command line gives one of the two
                run = selfcal_twin(case, seeds, watcher)
                files = [draft.folder / ANSWERS[0], draft.folder / recording_file.FILE_NAME]
                write_json(calibration_file(run), files[0])
                recording_file.write_recording(run.recording, files[1])
                with run.stages.time("pictures"):
                    shot, (sheet, room) = run.trials[0].acquisition.shots[0], PICTURES
                    files.append(detection_sheet(case, run.trials[0], draft.folder / sheet))
                    files.append(workcell_picture(case, shot.q_probe, shot.q_needle, draft.folder / room))
                if record_folder is not None:
                    keep_pictures(run.trials[0].acquisition, case, record_folder)
            files.append(write_page(run, files[2:], draft.folder / ANSWERS[1]))
            draft.inputs, draft.seconds = run.inputs, run.stages.seconds
    except PlanningError:
        withdraw(out, "selfcal", keep=(recording_file.FILE_NAME,))
        raise
    return replace(run, files=draft.final(files))


def calibration_file(run: SelfcalRun) -> dict[str, Any]:
    """Content of ``calibration.json``."""
    calibration = run.calibration
    return {
        "version": VERSION,
        "name": run.name,
        "seed": run.trials[0].seed if run.trials else None,
        "inputs": inputs_document(run.inputs),
        **calibration_summary(calibration, run.recording),
        "residuals_mm": dict(zip(run.recording.names, calibration.residuals.tolist(), strict=True)),
        "parameters": list(calibration.parameters),
        "covariance": calibration.covariance_counts.tolist(),
        "region_limit_95": calibration.region_limit(),
        "shots": [shot._asdict() for shot in run.shots],
    }


def selfcal_facts(run: SelfcalRun) -> dict[str, Any]:
    """Facts of a self-calibration: poses, calibration, trials, punctures, and files."""
    return {
        **calibration_summary(run.calibration, run.recording),
        "name": run.name,
        "inputs": inputs_document(run.inputs),
        "candidates": None if run.candidates is None else run.candidates.counts,
        "choice": run.choice,
        "shots": [shot._asdict() for shot in run.shots],
        "trials": [selfcal_trial.trial_summary(trial) for trial in run.trials],
        "punctures": selfcal_trial.puncture_summary(run.punctures),
        "seconds": {stage: round(seconds, 3) for stage, seconds in run.stages.seconds.items()},
        "files": [str(path) for path in run.files],
        "warnings": list(run.warnings),
    }


def selfcal_text(facts: Facts) -> str:
    """The sections for a terminal, then the files."""
    notes = tuple(f"note: {one['sentence']}" for one in facts["findings"] if one["severity"] == "note")
    head = Section(f"{'case' if facts['trials'] else 'recording'} {facts['name']}", [Warn(notes)] if notes else [])
    return present.text([head, *sections(facts), *present.footer(facts["files"], facts["warnings"], facts["seconds"])])


def write_page(run: SelfcalRun, pictures: Sequence[Path], path: Path) -> Path:
    """Write the page, with the sheet of pictures and the workcell where the twin drew them."""
    facts, seed = selfcal_facts(run), run.trials[0].seed if run.trials else None
    residuals = present.picture(residual_picture(run.calibration, run.recording), "Residual of each pose, and v over u")
    X, Y = _matrix(run.calibration.X), _matrix(run.calibration.Y)
    matrices = present.facts([("T_end1_image (X), mm", X), ("T_base1_base2 (Y), mm", Y)])
    sigma = np.sqrt(np.maximum(np.diag(run.calibration.covariance), 0.0)).tolist()
    deviations = in_degrees(dict(zip(run.calibration.parameters, sigma, strict=True)))
    known = Table(("parameter", "sd"), tuple((name, f"{value:.4f}") for name, value in deviations.items()))
    uncertainty = Section("uncertainty of each parameter", [matrices, known, PARAMETERS])
    shown = [*sections(facts)]
    shown[2:2] = [uncertainty, Section("residuals", [RESIDUALS, residuals])]
    if pictures:
        if run.punctures:
            errors = present.picture(puncture_picture(run.punctures), "Error of every target, and the expected error")
            shown.insert(5, Section("", [errors]))
        sheet = present.picture(pictures[0], "B-mode pictures with detected and true tips")
        words = "One recorded pose. The needle is drawn 3 mm thick; blue: the slice in the image."
        shown += [
            Section("B-mode pictures", [f"Seed {seed}. The detector sees only the grey picture.", sheet]),
            Section("the workcell", [present.picture(pictures[1], "Both arms about the phantom"), words]),
        ]
    title, origin = f"{run.name}: ultrasound self-calibration", present.origin_section(seed)
    return present.write_page(path, title, EQUATION, _cards(facts), shown, run.inputs, origin=origin)


def sections(facts: Facts) -> list[Section]:
    """Sections of a self-calibration, for terminal and page."""
    arms, known = facts["arms"], [(NOISE_TEXT[key], number(value, 3)) for key, value in facts["noise"].items()]
    if arms is not None:
        known.insert(0, ("χ² of the residuals per degree of freedom", number(arms["chi2_per_freedom"], 2)))
    shown = [
        Section("what the data cannot determine", [Warn(tuple(facts["cannot_show"]))]),
        Section("calibration", [present.facts([*CALIBRATION, *known], facts)]),
    ]
    if facts["shots"]:
        words = "Each updated the calibration where it fits; residuals above are those of the recording."
        shown.append(Section("shots after the recording", [words, grid(SHOT, facts["shots"])]))
    if facts["trials"]:
        reached: list[Block] = ["No target could be reached without contact."]
        if facts["punctures"] is not None:
            reached = [PUNCTURED, present.facts(PUNCTURES, facts["punctures"])]
        shown += [
            Section("insertions to targets in the image", reached),
            Section("seeds, each its own trial", [grid(TRIAL, facts["trials"]), HELD_OUT]),
            Section("poses", _poses(facts)),
        ]
    return shown


PUNCTURED = (
    "In the twin, with the true arms: the target is read in the image (with reading error) and the needle arm "
    "moves there by the calibration. These targets were not recorded before."
)


CALIBRATION = (
    Field("poses used", lambda one: f"{one['poses'] - len(one['set_aside'])} of {one['poses']}"),
    Field("set aside", lambda one: ", ".join(one["set_aside"]) or "none"),
    Field("pictures without a needle", lambda one: _named(one["without_needle"])),
    Field("residuals, rms", "residual_rms_mm", 3, "mm"),
    Field("expected tip error, rms", lambda one: f"{one['predicted_tre_mm']:.3f} mm, {counted(one)}"),
    Field("tip in the needle's flange frame", lambda one: present.vector(one["tip_end2_mm"], 3, "mm")),
    Field("needle direction there", lambda one: present.vector(one["needle_direction_end2"], 5)),
    Field("iterations", "iterations"),
    Field("condition σ_min/σ_max, lengths in 100 mm", lambda one: f"{one['condition']:.2e}"),
)
TRIAL = (
    Field("seed", lambda one: str(one["seed"])),
    Field("residual rms", "residual_rms_mm", 3, "mm"),
    Field("expected error", "predicted_tre_mm", 3, "mm"),
    Field("held-out tip error rms", "held_out_error_rms_mm", 3, "mm"),
    Field("tip found: mean along", lambda one: one["detected_tip_along_mm"][0], 2, "mm"),
    Field("sd", lambda one: one["detected_tip_along_mm"][1], 2, "mm"),
    Field("angle sd", lambda one: one["detected_angle_deg"][1], 2, "°"),
    Field("tip to target rms", lambda one: one["punctures"] and one["punctures"]["error_rms_mm"], 2, "mm"),
    Field("true contacts", "true_contacts"),
    Field("not used", lambda one: "; ".join(f"{count} {why}" for why, count in one["missed"].items()) or "none"),
    Field("set aside", lambda one: ", ".join(one["set_aside"]) or "none"),
)
SHOT = (
    Field("shot", "name"),
    Field("χ²", "chi_squared", 1),
    Field("fits below", "limit", 1),
    Field("", lambda one: "used" if one["used"] else "does not fit: left out"),
)
PUNCTURES = (
    Field("targets", "targets"),
    Field("true tip to true target, rms", "error_rms_mm", 2, "mm"),
    Field("median", "error_median_mm", 2, "mm"),
    Field("worst", "error_worst_mm", 2, "mm"),
    Field("across the needle, rms", "lateral_rms_mm", 2, "mm"),
    Field("along the needle, mean (+ is too deep)", "depth_mean_mm", 2, "mm"),
    Field("along the needle, rms", "depth_rms_mm", 2, "mm"),
    Field("expected (rms): calibration and arms", "predicted_rms_mm", 2, "mm"),
    Field("expected (rms): with the target's reading", "predicted_with_reading_rms_mm", 2, "mm"),
)


def _named(some: Facts) -> str:
    return f"{len(some)}: {', '.join(some)}" if some else "none"


def counted(facts: Facts) -> str:
    """Text of what the expected error counts."""
    return "noise alone" if facts["arms"] is None else "noise and declared errors of the arms"


def _poses(facts: Facts) -> list[Block]:
    choice, recorded = facts["choice"], facts["poses"]
    counts = [(REASON_TEXT[key], f"{value:,}") for key, value in facts["candidates"].items() if value]
    bounds = (
        Field(f"expected error with the {recorded} recorded poses", "chosen_bound_mm", 3, "mm"),
        Field(f"{recorded} at random, median of {choice['random_sets']} choices", "random_bound_median_mm", 3, "mm"),
        Field("at random, the best of them", "random_bound_best_mm", 3, "mm"),
    )
    outcomes = Table(("outcome of the drawn poses", "draws"), tuple(counts))
    return [(outcomes, present.facts(bounds, choice)), "Cramér-Rao bounds over all candidates, with the usual noise."]


def _matrix(T: Any) -> Markup:
    lines = ["  ".join(f"{value:10.5f}" for value in row[:3]) + f"  {row[3]:9.3f}" for row in T[:3]]
    return Markup("<pre>{}</pre>").format("\n".join(lines))


def _cards(facts: Facts) -> list[Card]:
    aside, poses, reached = facts["set_aside"], facts["poses"], facts["punctures"]
    expected = number(facts["predicted_tre_mm"], 2, "mm")
    cards = [
        Card("expected error of the calibration", expected, f"rms at the tip: {counted(facts)}"),
        Card("residuals", number(facts["residual_rms_mm"], 2, "mm"), "rms over the poses used"),
        Card("poses", f"{poses - len(aside)} of {poses}", f"set aside: {', '.join(aside) or 'none'}"),
    ]
    if reached is not None:
        detail = (
            f"rms over {reached['targets']} targets, worst {number(reached['error_worst_mm'], 2, 'mm')}; expected "
            f"from calibration, arms and reading: {number(reached['predicted_with_reading_rms_mm'], 2, 'mm')}"
        )
        cards.insert(0, Card("tip to target, true", number(reached["error_rms_mm"], 2, "mm"), detail))
    return cards


def residual_picture(calibration: Calibration, recording: Recording) -> bytes:
    """A PNG of each pose's residual in the image frame: its three components, and v over u; set aside by name."""
    rotated = np.einsum("nji,nj->ni", recording.A[:, :3, :3] @ calibration.X[:3, :3], calibration.residuals)
    aside = np.isin(recording.names, calibration.outliers)
    figure = Figure(figsize=(12.0, 4.0), dpi=110, layout="constrained")
    by_pose, in_image = figure.subplots(1, 2)
    for axis, label in enumerate(("u, along the face", "v, into the depth", "across the slice")):
        by_pose.plot(np.flatnonzero(~aside), rotated[~aside, axis], "o", ms=4, color=COLOURS[axis], label=label)
        by_pose.plot(np.flatnonzero(aside), rotated[aside, axis], "x", color=SET_ASIDE)
    in_image.plot(*rotated[~aside, :2].T, "o", ms=4, color=COLOURS[0], label="used")
    in_image.plot(*rotated[aside, :2].T, "x", color=SET_ASIDE, label="set aside")
    for row in np.flatnonzero(aside):
        in_image.annotate(recording.names[row], rotated[row, :2], (5, 3), textcoords="offset points", fontsize=8)
    by_pose.set(xlabel="pose", ylabel="residual, mm")
    in_image.set(xlabel="residual along u, mm", ylabel="residual along v, mm", aspect="equal", adjustable="datalim")
    return _finished(figure)


def puncture_picture(reached: Sequence[selfcal_trial.Puncture]) -> bytes:
    """A PNG of every target's error, in the order reached, beside what calibration and reading let expect."""
    x = np.arange(1, len(reached) + 1)
    figure = Figure(figsize=(12.0, 3.6), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    axes.plot(x, [one.error_mm for one in reached], "o", color=COLOURS[0], label="distance")
    axes.plot(x, [one.lateral_mm for one in reached], "o", color=COLOURS[2], label="across the needle")
    expected = [one.expected_mm for one in reached]
    axes.plot(x, expected, "--", color="#5b616b", label="expected (rms): calibration and reading")
    axes.set(xlabel="target", ylabel="true tip to true target, mm", ylim=(0, None))
    return _finished(figure)


def _finished(figure: Figure) -> bytes:
    for axes in figure.axes:
        axes.grid(color="0.9")
        axes.set_axisbelow(True)
        axes.legend(fontsize=8)
    return png(figure)
