"""The commands of a cohort from outside: codes, lines, Ctrl-C, a disk, a clock."""

import errno
import os
import signal
import subprocess
import sys
import time
from functools import partial

import pytest
from cohort_world import merged, run_here, write_cohort, write_patient
from places import ROOT

from puncture_twin.planning.batch.plan import WORK_PREFIX
from puncture_twin.planning.batch.run import slurm_part
from puncture_twin.run_twin import main


@pytest.fixture
def planned(tmp_path):
    write_cohort(tmp_path / "c")
    assert main(["batch", "plan", str(tmp_path / "c"), "--out", str(tmp_path / "out"), "--no-arm"]) == 0
    return tmp_path / "out"


def said(capfd, code, *words):
    """What a command says on stderr in its one line, with its exit code."""
    capfd.readouterr()
    assert main([str(word) for word in words]) == code
    return capfd.readouterr()


def test_a_dry_run_measures_and_writes_nothing(tmp_path, capfd):
    """How many, how long, how much memory and disk."""
    write_cohort(tmp_path / "c", 3)
    words = ("batch", "plan", tmp_path / "c", "--out", tmp_path / "out", "--no-arm", "--dry-run", "--jobs", "2")
    lines = said(capfd, 0, *words).out.splitlines()
    assert lines[0] == "3 cases, 0 already with a row" and "p2/case.toml" in lines[1]
    assert lines[2].startswith("measured at p0/case.toml: 0.")
    assert "MB of memory" in lines[3] and "MB of disk" in lines[3]
    assert not (tmp_path / "out").exists()


def test_ctrl_c_stops_with_130_and_a_second_run_continues(planned):
    """What is done stays; no worker, no draft is left; nothing is said but that it was interrupted."""
    for number in range(3, 12):
        write_patient(planned.parent / "c" / f"p{number}", ("position_mm = [0.0,", f"position_mm = [{number / 4},"))
    assert main(["batch", "plan", str(planned.parent / "c"), "--out", str(planned), "--no-arm"]) == 0
    program = [sys.executable, str(ROOT / "run_twin.py"), "batch", "run", "--out", str(planned)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    told = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    hears = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a test in the background ignores it
    process = subprocess.Popen(program, env=environment, start_new_session=True, preexec_fn=hears, **told)
    deadline = time.monotonic() + 120
    while not any(planned.glob(f"{WORK_PREFIX}*/*")) and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert out == "" and [line for line in err.splitlines() if not line.startswith("cases: ")] == ["interrupted"]
    assert not list(planned.glob(f"{WORK_PREFIX}*"))
    run_here(planned.parent / "c", planned)
    assert main(["batch", "merge", "--out", str(planned)]) == 0
    assert all(row["exit_code"] is not None for row in merged(planned).values())


def test_the_part_of_a_slurm_array_is_taken_and_told(planned, monkeypatch, capfd):
    """Without ``--part``; one that is typed counts instead."""
    for name, value in (("ID", "7"), ("COUNT", "3"), ("MIN", "5")):
        monkeypatch.setenv(f"SLURM_ARRAY_TASK_{name}", value)
    assert slurm_part(os.environ).text == "3/3"
    found = said(capfd, 1, "batch", "run", "--out", planned)
    assert "part 3/3, from SLURM's array" in found.err and found.out.startswith(
        "1 case: 0 already had a row, 0 done, 1 failed"
    )
    again = said(capfd, 1, "batch", "run", "--out", planned, "--part", "3/3").out
    assert again.startswith("1 case: 1 already had a row (1 refused), 0 done, 0 failed")
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "9")
    assert "SLURM's array" in said(capfd, 2, "batch", "run", "--out", planned).err


def test_what_cannot_be_run_is_one_line(planned, tmp_path, capfd):
    """No plan, no part, a plan that was edited, a folder that cannot be written to, the old command."""
    for words, line in (
        (("run", "--out", tmp_path / "new"), "has no plan"),
        (("status", "--out", tmp_path / "new"), "has no plan"),
        (("merge", "--out", tmp_path / "new"), "has no plan"),
        (("run", "--out", planned, "--part", "4/3"), "is not a part"),
        (("plan", tmp_path / "nothing", "--out", planned), "is not a cohort"),
        (("compare", planned, planned), "no such file"),
        (("plan", planned.parent / "c", "--out", "/proc/nowhere"), "cannot be written"),
        ((str(planned.parent / "c" / "p0"),), "No such command"),
    ):
        found = said(capfd, 2, "batch", *words)
        assert len(found.err.strip().splitlines()) == 1 and line in found.err and "allowed: " in found.err, found.err
        assert found.out == ""
    (planned / "plan.parquet").write_bytes(b"PAR1")
    assert "does not match its entry" in said(capfd, 2, "batch", "run", "--out", planned).err


def test_a_full_disk_is_one_line_and_the_merged_set_stays(planned, tmp_path, monkeypatch, capfd):
    """While it merges: what was there before is untouched."""
    run_here(tmp_path / "c", planned)
    assert main(["batch", "merge", "--out", str(planned)]) == 0
    before = {path: path.read_bytes() for path in planned.rglob("*") if path.is_file()}

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("puncture_twin.planning.batch.merge.write_dataset", full)
    assert "cannot be written (No space left on device)" in said(capfd, 2, "batch", "merge", "--out", planned).err
    assert {path: path.read_bytes() for path in planned.rglob("*") if path.is_file()} == before


def test_the_clock_decides_nothing(planned, tmp_path, monkeypatch):
    """Dates in the past or the future change neither state nor table; a clock that is set back neither."""
    run_here(tmp_path / "c", planned)
    assert main(["batch", "merge", "--out", str(planned)]) == 0
    before = {name: (planned / name).read_bytes() for name in ("cases.parquet", "cohort.html")}
    for number, path in enumerate(sorted(tmp_path.rglob("*"))):
        os.utime(path, (number * 1e8, (40 - number % 40) * 1e8))
    monkeypatch.setattr("time.time", lambda: 1.0)
    assert main(["batch", "run", "--out", str(planned)]) == 1  # one was refused
    assert main(["batch", "status", "--out", str(planned)]) == 0
    assert main(["batch", "merge", "--out", str(planned)]) == 0
    assert {name: (planned / name).read_bytes() for name in before} == before
