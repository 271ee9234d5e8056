"""The same case gives the same bytes, whatever the machine's clock, language, thread count and working folder."""

import os
import shutil
import subprocess
import sys

import pytest
from places import ROOT

from puncture_twin.meshes import folder
from puncture_twin.planning.base.output.manifest import TIMINGS_NAME

COMMANDS = {"search": ["--no-arm", "--certify", "--certify-size", "4"], "rehearse": []}
"""To rehearse a case is to plan it first, into the same folder."""

ANGLES = ["--theta", "18", "--beta", "232"]
EXPERIMENT = {
    "scan": (["scan", "--spacing", "5", "--pixel", "2"], {"scan.json", "markers_ct.csv", "ct.nii.gz", "scan.png"}),
    "touch": (["touch", *ANGLES], {"touch.csv", "touch.json"}),
    "pivot": (["pivot", "--poses", "4"], {"pivot.csv", "pivot.json"}),
    "sweep": (["rehearse", *ANGLES, "--sweep", "--to", "19,231"], {"sweep.json"}),
}
"""Commands of the experiment, and what each writes at least."""

ENVIRONMENTS = (
    {"PYTHONHASHSEED": "1", "TZ": "UTC", "LC_ALL": "C", "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    {"PYTHONHASHSEED": "77", "TZ": "Asia/Tokyo", "LC_ALL": "de_DE.UTF-8", "NUMBA_NUM_THREADS": "2"},
)


CORES = sorted(os.sched_getaffinity(0))


def start(words, case, out, environment, working_folder):
    """A command in a process of its own, in one of the environments; the one with one thread has one core."""
    cores = CORES[: int(environment["NUMBA_NUM_THREADS"])]
    program = ROOT / "run_twin.py"
    paths = [str(program.parent), os.environ.get("PYTHONPATH", "")]
    return subprocess.Popen(
        [sys.executable, str(program), words[0], str(case), "--out", str(out), *words[1:]],
        cwd=working_folder,
        env={**os.environ, **environment, "PYTHONPATH": os.pathsep.join(paths)},
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def twice(words, case, tmp_path):
    """The names of the files that a command writes in both environments, and those that differ."""
    first, second = tmp_path / "first", tmp_path / "second"
    runs = [
        start(words, case.name, first, ENVIRONMENTS[0], case.parent),
        start(words, case, second, ENVIRONMENTS[1], tmp_path),
    ]
    for run in runs:
        said = run.communicate(timeout=600)
        assert run.returncode == 0, said
    names, others = (
        {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()} for out in (first, second)
    )
    assert names == others
    return names, {name for name in names if (first / name).read_bytes() != (second / name).read_bytes()}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_environment_gives_the_same_bytes(command, tmp_path):
    """Page, pictures, table, certificate, plan, film and manifest, byte for byte; only the timings differ."""
    here = tmp_path / "case"
    shutil.copytree(folder() / "carton", here)
    case = here / "case_m.toml"
    case.write_text(case.read_text().replace("step_deg = 2.0", "step_deg = 15.0"))
    names, differ = twice([command, *COMMANDS[command]], case, tmp_path)
    assert {"report.html", "candidates.parquet", TIMINGS_NAME} < names
    assert ("plan.json" in names) == (command != "search")
    assert ("rehearsal.mp4" in names) == (command == "rehearse")
    assert ("certificate.json" in names) == (command == "search")
    assert differ <= {TIMINGS_NAME}


@pytest.mark.parametrize("command", EXPERIMENT)
def test_every_environment_measures_the_same(command, tmp_path):
    """Scans, touches, pivots and sweeps, simulated arm and noise included, byte for byte."""
    shutil.copytree(folder() / "carton", tmp_path / "case")
    words, written = EXPERIMENT[command]
    names, differ = twice(words, tmp_path / "case" / "case_m.toml", tmp_path)
    assert written < names
    assert differ <= {TIMINGS_NAME}
