"""The jobs behind the command line: a servo case, or the paper, from file to pictures and page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.progress import Count
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase, load_servo_case
from puncture_twin.twin.jobs.servo import liu2007
from puncture_twin.twin.jobs.servo.liu2007 import finished_sessions
from puncture_twin.twin.jobs.servo.pictures import draw_cameras, draw_convergence
from puncture_twin.twin.jobs.servo.report import (
    Facts,
    Pictures,
    reproduction_facts,
    servo_facts,
    servo_text,
    write_servo_page,
)
from puncture_twin.twin.rehearsal.stereo_session import Session

NAMES = ("servo.html", "convergence.png", "camera_1.png", "camera_2.png")


class ServoJob(NamedTuple):
    """What came of a job."""

    passed: bool
    """Whether every servo converged; for the paper, whether every condition that is printed holds."""
    summary: dict[str, Any]
    """Plain values."""
    text: str
    """For a person."""


def run_servo(
    path: Path,
    out_dir: Path,
    seeds: int,
    done: Count | None = None,
    note: Callable[[str], None] | None = None,
) -> ServoJob:
    """Hold the sessions of a case and write pictures, plot and page.

    Args:
        path: The case.
        out_dir: Folder for the files.
        seeds: How many, from the case's own on.
        done: Told how many of how many are done.
        note: Told what was removed that nobody might expect.

    Raises:
        InputError: The case cannot be used.
        NoAnswerError: The first session could not be held.
    """
    case = load_servo_case(path)
    with writing(out_dir, "servo", inputs=case.inputs, names=NAMES, note=note) as draft:
        result = finished_sessions(case, seeds, done)
        facts = servo_facts(case, result.trials, result.ours)
        written = _files(case, result.first, facts, draft.folder)
    facts["files"] = [str(path) for path in draft.final(written)]
    return ServoJob(result.ours.not_confirmed == 0.0 and result.ours.refused == 0, facts, servo_text(facts))


def reproduce_paper(out_dir: Path, seeds: int | None) -> ServoJob:
    """Print the paper's tables beside ours, and write pictures, plot and page."""
    with writing(out_dir, "reproduce", names=NAMES) as draft:
        result = liu2007.reproduce(seeds)
        draft.inputs = result.tilted.case.inputs
        facts = reproduction_facts(result)
        written = _files(result.tilted.case, result.tilted.first, facts, draft.folder)
    facts["files"] = [str(path) for path in draft.final(written)]
    return ServoJob(result.passed, facts, servo_text(facts))


def _files(case: ServoCase, first: Session, facts: Facts, out_dir: Path) -> list[Path]:
    """Write everything; returns the paths."""
    pictures = draw_cameras(first, out_dir)
    convergence = out_dir / "convergence.png"
    draw_convergence(first, convergence)
    return [
        write_servo_page(case, facts, Pictures(convergence, pictures), out_dir / "servo.html"),
        convergence,
        *pictures,
    ]
