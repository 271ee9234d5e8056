"""The jobs behind the command line: a servo case, or a recorded session, from file to pictures and page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import new_folder
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.progress import Count, uncounted
from puncture_twin.twin.guidance.stereo.detection import image_detector
from puncture_twin.twin.guidance.stereo.recording import read_recording
from puncture_twin.twin.guidance.stereo.robot_calibration import calibrate_by_robot
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase, load_servo_case
from puncture_twin.twin.guidance.stereo.servo_law import Posture
from puncture_twin.twin.guidance.stereo.session import follow, map_markers
from puncture_twin.twin.jobs.servo.pictures import draw_cameras, draw_convergence
from puncture_twin.twin.jobs.servo.report import (
    Facts,
    Pictures,
    recording_facts,
    recording_text,
    servo_facts,
    servo_text,
    write_servo_page,
)
from puncture_twin.twin.jobs.terminal import Answer
from puncture_twin.twin.rehearsal.stereo_session import ServoTrial, Session, run_session, run_trials, statistics
from puncture_twin.twin.report.present import Section

NAMES = ("servo.html", "convergence.png", "camera_1.png", "camera_2.png")


class Sessions(NamedTuple):
    """A case's sessions: that of the first seed in full, the trial of every seed, and the statistics over all."""

    case: ServoCase
    first: Session
    trials: tuple[ServoTrial, ...]
    ours: dict[str, Any]


def hold_sessions(case: ServoCase, seeds: int, done: Count = uncounted, record: Path | None = None) -> Sessions:
    """Hold the sessions of a case, from its own seed on.

    Args:
        record: An empty folder for all that the devices of the first session say.
    """
    seed = case.file.seed
    first = run_session(case, seed, record=record)
    done(1, seeds)
    others = run_trials(case, range(seed + 1, seed + seeds), lambda at, of: done(at + 1, seeds))
    trials = (first.trial, *others)
    return Sessions(case, first, trials, statistics(trials))


def run_servo(
    path: Path,
    out_dir: Path,
    seeds: int,
    done: Count = uncounted,
    note: Callable[[str], None] | None = None,
    record: Path | None = None,
) -> Answer:
    """Hold the sessions of a case and write pictures, plot and page.

    Args:
        record: A folder that is not there yet, for all that the devices of the first session say.

    Raises:
        InputError: The case cannot be used.
        NoAnswerError: The first session could not be held.
    """
    case = load_servo_case(path)
    with writing(out_dir, "servo", inputs=case.inputs, names=NAMES, note=note) as draft:
        with new_folder(record) as kept:
            held = hold_sessions(case, seeds, done, kept)
        facts = servo_facts(case, held.trials, held.ours)
        written = session_files(held, facts, draft.folder)
    facts["files"] = [str(path) for path in draft.final(written)]
    passed = held.ours["not_confirmed"] == 0.0 and held.ours["refused"] == 0
    return Answer(passed, facts, servo_text(facts))


def refuse_with_recording(out_dir: Path | None, record: Path | None, seeds: int) -> None:
    """A recorded session is read: nothing is drawn or written.

    Raises:
        InputError: One of the options that draw or write is given too.
    """
    if out_dir is not None or record is not None or seeds != 1:
        refuse("--out, --record and --seeds", "servo --recording", "--recording FOLDER alone", "conflicting_options")


def follow_recording(path: Path, recording: Path) -> Answer:
    """Calibrate and map from a recorded session, and say what each of its looks at the ball says.

    Args:
        recording: Its folder; see `twin.guidance.stereo.recording`.

    Raises:
        InputError: Case or recording cannot be used.
        NoAnswerError: A point or a marker is not found in its pictures.
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
    mapping, guide = map_markers(case, calibration, detector, replay, reading)
    looks = list(follow(case, guide, calibration.T_base_c, reading.targets_m, replay.stops, replay))
    facts = recording_facts(case, recording, calibration, mapping, looks)
    return Answer(facts["converged"], facts, recording_text(facts))


def session_files(held: Sessions, facts: Facts, out_dir: Path, paper: Sequence[Section] = ()) -> list[Path]:
    """Write pictures, plot and page of the first session; returns the paths."""
    pictures = draw_cameras(held.first, out_dir)
    convergence = out_dir / "convergence.png"
    draw_convergence(held.first, convergence)
    shown = Pictures(convergence, pictures)
    return [write_servo_page(held.case, facts, shown, out_dir / "servo.html", paper), convergence, *pictures]
