"""The command ``selfcal``: run, then write every file that shows it."""

from __future__ import annotations

from pathlib import Path

from planning.prepared import Watcher
from twin.ultrasound.page import write_page
from twin.ultrasound.pictures import detection_sheet, room_picture
from twin.ultrasound.selfcal import SelfcalRun, selfcal_recording, selfcal_twin, write_run
from twin.ultrasound.selfcal_case import load_selfcal_case

ANSWERS = ("calibration.json", "report.html", "bmode.png", "room.png")
"""Files that hold an answer. Not the recording, which may be the input."""


def run_selfcal(case_path: Path | None, recording: Path | None, seeds: int, out: Path, watcher: Watcher) -> SelfcalRun:
    """Simulate a case, or calibrate a recording, and write everything into a folder.

    Args:
        case_path: The case, or its folder; None only beside a recording.
        recording: A recording's CSV or folder; None to simulate.
        seeds: Rooms that are drawn, from the case's seed on.
        out: Where files go.
        watcher: Shows progress.

    Raises:
        InputError: Something that cannot be used, or poses that cannot show every unknown.
        NoAnswerError: Not enough poses can be taken or show the needle.
    """
    case = None if case_path is None else load_selfcal_case(case_path)
    for name in ANSWERS:  # an earlier answer must not stand beside a refusal
        (out / name).unlink(missing_ok=True)
    if recording is not None:
        run = write_run(selfcal_recording(recording, case), out)
        return run.with_files(write_page(run, None, None, out / "report.html"))
    assert case is not None  # the command line gives one of the two
    run = write_run(selfcal_twin(case, seeds, watcher), out)
    with run.stages.time("pictures"):
        trial = run.trials[0]
        sheet = detection_sheet(case, trial, out / "bmode.png")
        shot = trial.acquisition.shots[0]
        room = room_picture(case, shot.q_probe, shot.q_needle, out / "room.png")
    return run.with_files(sheet, room, write_page(run, sheet, room, out / "report.html"))
