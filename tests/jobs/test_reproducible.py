"""The same case gives the same bytes, whatever the machine's clock, language, thread count and working folder."""

import os
import shutil
import subprocess
import sys

import pytest
from places import ROOT

from puncture_twin.meshes import folder
from puncture_twin.planning.base.output.manifest import TIMINGS_NAME

COMMANDS = {
    "search": ["--no-arm", "--certify", "--certify-size", "4"],
    "rehearse": [],
}
"""To rehearse a case is to plan it first, into the same folder."""

ENVIRONMENTS = (
    {"PYTHONHASHSEED": "1", "TZ": "UTC", "LC_ALL": "C", "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    {"PYTHONHASHSEED": "77", "TZ": "Asia/Tokyo", "LC_ALL": "de_DE.UTF-8", "NUMBA_NUM_THREADS": "2"},
)


CORES = sorted(os.sched_getaffinity(0))


def start(command, case, out, environment, working_folder):
    """The command in a process of its own, in one of the environments; the one with one thread has one core."""
    cores = CORES[: int(environment["NUMBA_NUM_THREADS"])]
    program = ROOT / "run_twin.py"
    paths = [str(program.parent), os.environ.get("PYTHONPATH", "")]
    return subprocess.Popen(
        [sys.executable, str(program), command, str(case), "--out", str(out), *COMMANDS[command]],
        cwd=working_folder,
        env={**os.environ, **environment, "PYTHONPATH": os.pathsep.join(paths)},
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_every_environment_gives_the_same_bytes(command, tmp_path):
    """Page, pictures, table, certificate, plan, film and manifest, byte for byte; only the timings differ."""
    here = tmp_path / "case"
    shutil.copytree(folder() / "carton", here)
    case = here / "case_m.toml"
    case.write_text(case.read_text().replace("step_deg = 2.0", "step_deg = 15.0"))
    first, second = tmp_path / "first", tmp_path / "second"
    runs = [
        start(command, "case_m.toml", first, ENVIRONMENTS[0], here),
        start(command, case, second, ENVIRONMENTS[1], tmp_path),
    ]
    for run in runs:
        said = run.communicate(timeout=600)
        assert run.returncode == 0, said
    names = {path.name for path in first.iterdir()}
    assert names == {path.name for path in second.iterdir()}
    assert {"report.html", "candidates.parquet", TIMINGS_NAME} < names
    assert ("plan.json" in names) == (command != "search")
    assert ("rehearsal.mp4" in names) == (command == "rehearse")
    assert ("certificate.json" in names) == (command == "search")
    differ = [name for name in sorted(names) if (first / name).read_bytes() != (second / name).read_bytes()]
    assert set(differ) <= {TIMINGS_NAME}
