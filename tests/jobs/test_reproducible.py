"""The same case gives the same bytes, whatever the machine's clock, language, thread count and working folder."""

import os
import shutil
import subprocess
import sys

import pytest
from case_world import coarse_carton
from places import ROOT

from puncture_twin.meshes import folder
from puncture_twin.planning.base.output.manifest import TIMINGS_NAME
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import OK

COMMANDS = {"search": ["--no-arm", "--certify", "--certify-size", "4"], "rehearse": []}
"""To rehearse a case is to plan it first, into the same folder."""

EXPERIMENT = {
    "scan": (["scan", "--spacing", "5", "--pixel", "2"], {"scan.json", "markers_ct.csv", "ct.nii.gz", "scan.png"}),
    "touch": (["touch", "--theta", "18", "--beta", "232"], {"touch.csv", "touch.json"}),
}
"""Commands of the experiment, and what each writes at least."""

OTHER = {
    "PYTHONHASHSEED": "77",
    "TZ": "Asia/Tokyo",
    "LC_ALL": "de_DE.UTF-8",
    "NUMBA_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "PYTHONPATH": str(ROOT),
}
"""Beside this process' own: another clock, language, order of sets, and one thread."""


def elsewhere(words, case, out):
    """A command in a process of its own, in the other environment and the case's folder, on one core."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "run_twin.py"), words[0], case.name, "--out", str(out), *words[1:]],
        cwd=case.parent,
        env={**os.environ, **OTHER},
        preexec_fn=lambda: os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}),
        capture_output=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def twice(words, case, tmp_path):
    """The names of the files that a command writes here and elsewhere, and those that differ."""
    first, second = tmp_path / "first", tmp_path / "second"
    elsewhere(words, case, first)
    assert main([words[0], str(case), "--out", str(second), *words[1:]]) == OK
    names, others = (
        {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()} for out in (first, second)
    )
    assert names == others
    return names, {name for name in names if (first / name).read_bytes() != (second / name).read_bytes()}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_environment_gives_the_same_bytes(command, tmp_path):
    """Page, pictures, table, certificate, plan, film and manifest, byte for byte; only the timings differ."""
    case = coarse_carton(tmp_path / "case", 15.0)
    names, differ = twice([command, *COMMANDS[command]], case, tmp_path)
    assert {"report.html", "candidates.parquet", TIMINGS_NAME} < names
    assert ("plan.json" in names) == (command != "search")
    assert ("rehearsal.mp4" in names) == (command == "rehearse")
    assert ("certificate.json" in names) == (command == "search")
    assert differ <= {TIMINGS_NAME}


@pytest.mark.parametrize("command", EXPERIMENT)
def test_every_environment_measures_the_same(command, tmp_path):
    """Scans and touches, simulated arm and noise included, byte for byte."""
    shutil.copytree(folder() / "carton", tmp_path / "case")
    words, written = EXPERIMENT[command]
    names, differ = twice(words, tmp_path / "case" / "case_m.toml", tmp_path)
    assert written < names
    assert differ <= {TIMINGS_NAME}
