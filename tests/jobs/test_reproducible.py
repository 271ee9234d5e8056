"""The same case gives the same bytes, whatever the machine's clock, language, thread count and working folder."""

import json
import os
import subprocess
import sys

import pytest
from case_world import coarse_carton
from places import ROOT
from uncertainty_world import ball

from puncture_twin.planning.base.output.manifest import TIMINGS_NAME
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import OK
from puncture_twin.twin.report.scene import film

PAGE = {"report.html", "map.png", "scene.png", "slices.png", "candidates.parquet"}
COMMANDS = {
    "search": (["--no-pictures", "--certify", "--certify-size", "4"], {"certificate.json"}),
    "rehearse": ([], {*PAGE, "plan.json", "rehearsal.json", "rehearsal.mp4"}),
    "scan": (["--spacing", "5", "--pixel", "3"], {"scan.json", "markers_ct.csv", "ct.nii.gz", "scan.png"}),
    "touch": (["--theta", "18", "--beta", "232"], {"touch.csv", "touch.json"}),
}
"""Commands, and what each writes at least; to rehearse a case is to plan it first, into the same folder."""

OTHER = {
    "PYTHONHASHSEED": "77",
    "TZ": "Asia/Tokyo",
    "LC_ALL": "de_DE.UTF-8",
    "NUMBA_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "PYTHONPATH": str(ROOT),
}
"""Beside this process' own: another clock, language, order of sets, and one thread."""

PROGRAM = """
import json, sys
from puncture_twin.run_twin import main
from puncture_twin.twin.report.scene import film
film.LONGEST_S = film.STILL_S = 0.4
for arguments in json.loads(sys.argv[1]):
    assert main(arguments) == 0, arguments
"""
"""A film of a second; a whole one, made in another process, is in test_own_arm_page."""


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    """The folder of the cases, and that of each command: the carton, coarse; what is rehearsed is a round patient."""
    here = tmp_path_factory.mktemp("cases")
    carton, patient = coarse_carton(here / "carton", 15.0), ball(here, errors="touch_mm = 0.2")
    return here, dict.fromkeys(COMMANDS, carton) | {"rehearse": patient}


@pytest.fixture(scope="module")
def elsewhere(cases, tmp_path_factory):
    """What all commands wrote in the other environment and the cases' folder, on one core: a folder each."""
    out, (here, case_of) = tmp_path_factory.mktemp("elsewhere"), cases
    asked = [
        [name, str(case_of[name].relative_to(here)), "--out", str(out / name), *options]
        for name, (options, _) in COMMANDS.items()
    ]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(asked)],
        cwd=here,
        env={**os.environ, **OTHER},
        preexec_fn=lambda: os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}),
        capture_output=True,
        timeout=1200,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.parametrize("command", COMMANDS)
def test_every_environment_gives_the_same_bytes(command, cases, elsewhere, tmp_path, monkeypatch):
    """Pages, pictures, tables, certificate, plan, film, scan and touches, noise included; only the timings differ."""
    monkeypatch.setattr("puncture_twin.twin.jobs.patient.rehearsed.worker_count", lambda wanted, pieces: 1)
    for length in ("LONGEST_S", "STILL_S"):
        monkeypatch.setattr(film, length, 0.4)
    (options, written), first, second = COMMANDS[command], elsewhere / command, tmp_path / "here"
    assert main([command, str(cases[1][command]), "--out", str(second), *options]) == OK
    names, others = ({str(one.relative_to(out)) for one in out.rglob("*") if one.is_file()} for out in (first, second))
    assert names == others > {*written, TIMINGS_NAME}
    assert {name for name in names if (first / name).read_bytes() != (second / name).read_bytes()} <= {TIMINGS_NAME}
