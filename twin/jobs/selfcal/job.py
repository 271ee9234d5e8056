"""The command ``selfcal``: run, then write ``calibration.json`` and every file that shows it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.errors import PlanningError
from puncture_twin.planning.base.output.output_set import withdraw, writing
from puncture_twin.planning.base.output.publish import Draft
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.twin.guidance.ultrasound.recording_file import FILE_NAME, write_recording
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase, load_selfcal_case
from puncture_twin.twin.guidance.ultrasound.summaries import calibration_summary
from puncture_twin.twin.jobs.selfcal.pictures import detection_sheet, workcell_picture
from puncture_twin.twin.jobs.selfcal.report import write_page
from puncture_twin.twin.jobs.selfcal.selfcal import SelfcalRun, selfcal_recording, selfcal_twin
from puncture_twin.twin.jobs.terminal import write_json

COMMAND = "selfcal"
ANSWERS = ("calibration.json", "report.html")
PICTURES = ("bmode.png", "room.png")

VERSION = 2
"""Of ``calibration.json``. 2: ``inputs`` lists each file with its role."""


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
    names = ANSWERS if recording is not None else (*ANSWERS, *PICTURES, FILE_NAME)
    try:
        with writing(out, COMMAND, names=names, note=watcher.note) as draft:
            if recording is not None:
                run = _calibrated(case, recording, draft)
            else:
                assert case is not None  # the command line gives one of the two
                run = _simulated(case, seeds, draft, watcher)
            draft.inputs, draft.seconds = run.inputs, run.stages.seconds
    except PlanningError:
        withdraw(out, COMMAND, keep=(FILE_NAME,))
        raise
    return replace(run, files=draft.final(run.files))


def _calibrated(case: SelfcalCase | None, recording: Path, draft: Draft) -> SelfcalRun:
    """Calibrate a recording. One that an earlier run wrote into the folder stays there: it may be this one."""
    run = write_run(selfcal_recording(recording, case), draft.folder)
    draft.keep(FILE_NAME)
    return run.with_files(write_page(run, None, None, draft.folder / "report.html"))


def _simulated(case: SelfcalCase, seeds: int, draft: Draft, watcher: Watcher) -> SelfcalRun:
    """Run the twin, and draw what it saw."""
    run = write_run(selfcal_twin(case, seeds, watcher), draft.folder)
    with run.stages.time("pictures"):
        trial = run.trials[0]
        sheet = detection_sheet(case, trial, draft.folder / "bmode.png")
        shot = trial.acquisition.shots[0]
        picture = workcell_picture(case, shot.q_probe, shot.q_needle, draft.folder / "room.png")
    return run.with_files(sheet, picture, write_page(run, sheet, picture, draft.folder / "report.html"))


def write_run(run: SelfcalRun, out: Path) -> SelfcalRun:
    """Write ``calibration.json`` and, in the twin, the first seed's ``recording.csv``."""
    written = [write_json(calibration_file(run), out / "calibration.json")]
    if run.trials:
        write_recording(run.recording, out / FILE_NAME)
        written.append(out / FILE_NAME)
    return run.with_files(*written)


def calibration_file(run: SelfcalRun) -> dict[str, Any]:
    """What ``calibration.json`` holds."""
    found = run.calibration
    return {
        "version": VERSION,
        "name": run.name,
        "seed": run.trials[0].seed if run.trials else None,
        "inputs": inputs_document(run.inputs),
        **calibration_summary(found, run.recording),
        "residuals_mm": dict(zip(run.recording.names, found.residuals.tolist(), strict=True)),
        "parameters": list(found.parameters),
        "covariance": found.covariance_counts.tolist(),
        "region_limit_95": found.region_limit(),
    }
