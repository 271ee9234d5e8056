"""Ctrl-C in the middle of every command: 130, one line, and nothing half written."""

import shutil
import subprocess
import sys

import pytest
from kill_world import SELFCAL, coarse_cases
from places import ROOT

from puncture_twin.meshes import folder
from puncture_twin.planning.base.output.manifest import MANIFEST_NAME, problems
from puncture_twin.twin.jobs.exit_codes import INTERRUPTED

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
ENDED_BEFORE = 77  # the program's exit code where the command ended before it was interrupted: the machine is too fast
QUICK = {"batch", "init"}  # commands that take less than the second after which the others are interrupted

WRITING = {"search", "rehearse", "place", "batch", "selfcal"}
COMMANDS = sorted(WRITING | {"init", "live"})
"""One that loops, draws, simulates, serves or begins processes in its own way. One function ends them all:
tests/jobs/test_interrupt.py; `mirror`, which has then done what it was asked for, is in tests/jobs/test_mirror.py."""


@pytest.fixture(scope="module")
def typed(tmp_path_factory):
    here = tmp_path_factory.mktemp("ctrl-c")
    case = str(coarse_cases(here)[0])
    (here / "selfcal").mkdir()
    (here / "selfcal" / "selfcal.toml").write_text(SELFCAL)
    cohort = here / "cohort.csv"
    cohort.write_text(f"case\n{case}\n", encoding="utf-8")
    meshes = here / "meshes"
    meshes.mkdir()
    for mesh in (folder() / "abdomen").glob("*.ply"):
        shutil.copy(mesh, meshes)
    return {
        "init": [str(meshes), "--target=-90,-10,60"],
        "search": [case],
        "rehearse": [case],
        "place": [case, "--jobs", "1"],
        "live": [str(folder() / "abdomen"), "--port", "0"],
        "batch": ["plan", str(cohort)],
        "selfcal": [str(here / "selfcal")],
    }


def is_whole(out):
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
    out = tmp_path / "out"
    where = ["--out", str(out)] if command in WRITING else []
    done = interrupted(0.3 if command in QUICK else 1.0, [command, *typed[command], *where], out)
    said = done.stderr.splitlines()
    assert (done.returncode, said[-1:], "Traceback" in done.stderr) == (INTERRUPTED, ["interrupted"], False), (
        done.stderr
    )
    assert done.stdout == "" and list(tmp_path.iterdir()) == []
    assert command != "init" or not (ROOT / typed["init"][0] / "case.toml").exists()
