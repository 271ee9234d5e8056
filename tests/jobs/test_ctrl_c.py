"""Ctrl-C in the middle of every command: 130, one line, and nothing half written."""

import shutil
import subprocess
import sys

import numpy as np
import pytest
import typer
from hand_eye_world import hand_eye_problem, write_pairs
from kill_world import SELFCAL, coarse_cases
from places import ROOT

from puncture_twin.meshes import folder
from puncture_twin.planning.base.output.manifest import MANIFEST_NAME, problems
from puncture_twin.run_twin import app
from puncture_twin.twin.jobs.exit_codes import INTERRUPTED
from puncture_twin.twin.plant.scanner.writers import write_nifti

PROGRAM = """
import os, signal, sys, threading
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell starts what is in the background without it
from puncture_twin.run_twin import main
sent = threading.Event()
def send():
    sent.set()
    os.kill(os.getpid(), signal.SIGINT)
timer = threading.Timer(float(sys.argv[1]), send)
timer.daemon = True
timer.start()
code = main(sys.argv[2:])
timer.cancel()
sys.exit(code if sent.is_set() else %d)
"""
ENDED_BEFORE = 77
"""The program's exit code where the command ended before it was interrupted: the machine is too fast."""

QUICK = {"register", "verify", "init", "pivot", "batch", "schema", "calibrate", "confirm"}
"""Commands that take less than the second after which the others are interrupted."""

WRITING = {
    "demo",
    "search",
    "plan",
    "rehearse",
    "place",
    "export",
    "batch",
    "selfcal",
    "servo",
    "reproduce",
    "scan",
    "confirm",
    "touch",
    "markers",
}

ENDS_BY_CTRL_C = {"mirror"}
"""It follows an arm until then, and has done what it was asked for: tests/jobs/test_mirror.py."""

COMMANDS = sorted(set(typer.main.get_command(app).commands) - ENDS_BY_CTRL_C)


@pytest.fixture(scope="module")
def typed(tmp_path_factory):
    """The arguments of every command, of a coarse case."""
    here = tmp_path_factory.mktemp("ctrl-c")
    case = str(coarse_cases(here)[0])
    for name, text in (("selfcal", SELFCAL),):
        (here / name).mkdir()
        (here / name / f"{name}.toml").write_text(text)
    cohort = here / "cohort.csv"
    cohort.write_text(f"case\n{case}\n", encoding="utf-8")
    meshes = here / "meshes"
    meshes.mkdir()
    for mesh in (folder() / "abdomen").glob("*.ply"):
        shutil.copy(mesh, meshes)
    write_pairs(here / "pairs.csv", hand_eye_problem(np.random.default_rng(1), 20)[0])
    angles = ["--theta", "0", "--beta", "0"]
    control = write_nifti(
        here / "control.nii.gz", np.full((60, 60, 40), -1000, np.int16), np.diag([3.0, 3.0, 3.0, 1.0])
    )
    return {
        "demo": [],
        "init": [str(meshes), "--target=-90,-10,60"],
        "search": [case],
        "verify": [str(here / "certificate.json"), "--case", case],  # it reads the case first
        "check": [case, *angles],
        "compare": [case, "--rank", "1", "--rank", "2"],
        "plan": [case],
        "rehearse": [case],
        "place": [case, "--jobs", "1"],
        "live": [str(folder() / "abdomen"), "--port", "0"],
        "export": [case, "--format", "csv"],
        "register": [case],
        "batch": ["plan", str(cohort)],
        "scan": [case],
        "markers": [case, "--propose", "3"],
        "confirm": [case, "--scan", str(control)],
        "touch": [case],
        "pivot": [case, str(here / "joints.csv")],  # it reads the case first
        "selfcal": [str(here / "selfcal")],
        "servo": [str(folder() / "head")],
        "reproduce": ["chen2019"],
        "schema": [],
        "calibrate": ["hand-eye", "--recording", str(here / "pairs.csv")],
    }


def is_whole(out):
    """Whether a folder is there with all that its manifest lists."""
    return (out / MANIFEST_NAME).exists() and not problems(out)


def interrupted(seconds, arguments, out):
    """A command that is interrupted after some seconds; after fewer where it, or its folder, was complete by then."""
    while True:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM % ENDED_BEFORE, str(seconds), *arguments],
            capture_output=True,
            text=True,
            cwd=ROOT,
            check=False,
        )
        if done.returncode != ENDED_BEFORE and not is_whole(out):
            return done
        shutil.rmtree(out, ignore_errors=True)
        seconds /= 2


@pytest.mark.parametrize("command", COMMANDS)
def test_one_line_130_and_nothing_half_written(command, typed, tmp_path):
    """No traceback, no file, and no folder that was not there."""
    out = tmp_path / "out"
    where = ["--out", str(out)] if command in WRITING else []
    done = interrupted(0.3 if command in QUICK else 1.0, [command, *typed[command], *where], out)
    said = done.stderr.splitlines()
    assert (done.returncode, said[-1:], "Traceback" in done.stderr) == (INTERRUPTED, ["interrupted"], False), (
        done.stderr
    )
    assert done.stdout == "" and list(tmp_path.iterdir()) == []
    assert command != "init" or not (ROOT / typed["init"][0] / "case.toml").exists()
