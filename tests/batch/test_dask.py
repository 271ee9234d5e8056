"""A real scheduler with two worker processes on the loopback, one of which is killed in mid-work."""

import json
import os
import subprocess
import sys
import threading
import time

import cohort_world
import pytest
from cohort_world import merged, run_here, write_cohort
from places import ROOT, TESTS
from refusals import refused

from puncture_twin.planning.base.progress import Silent
from puncture_twin.planning.batch.plan import read_plan_table
from puncture_twin.planning.batch.run import on_scheduler, run_cohort
from puncture_twin.planning.batch.run_case import Limits
from puncture_twin.run_twin import main

TIME_LIMIT_S = 300.0
"""Of the whole: a try without an end is a failure, not a wait."""

CASES = 5


def start(module, *words):
    path = os.pathsep.join([str(ROOT), str(TESTS), os.environ.get("PYTHONPATH", "")])
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    program = [sys.executable, "-m", f"distributed.cli.{module}", *map(str, words), "--no-dashboard"]
    return subprocess.Popen(program, env={**os.environ, "PYTHONPATH": path}, **quiet)


@pytest.fixture
def scheduler(tmp_path):
    """Address of a scheduler, and its two workers; of two threads one, which must not meet in one of FCL's objects."""
    file = tmp_path / "scheduler.json"
    words = ("--host", "127.0.0.1", "--port", "0", "--scheduler-file", file)
    running = [start("dask_scheduler", *words)]
    deadline = time.monotonic() + 60
    while not file.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(0.2)
    address = json.loads(file.read_text())["address"]
    for threads in (1, 2):
        running.append(start("dask_worker", address, "--no-nanny", "--nthreads", threads, "--host", "127.0.0.1"))
    yield address, running[1:]
    for one in running:
        one.kill()
        one.wait()


def test_a_killed_worker_costs_no_case_and_none_is_committed_twice(scheduler, tmp_path):
    """Every case is run once at least and committed once; the merged table is that of an undisturbed cohort."""
    address, workers = scheduler
    write_cohort(tmp_path / "c", CASES)
    run_here(tmp_path / "c", tmp_path / "alone" / "out")
    out = tmp_path / "out"
    assert main(["batch", "plan", str(tmp_path / "c"), "--out", str(out), "--no-arm"]) == 0
    ids, found = [one.id for one in read_plan_table(out).cases], []

    def run():
        found.append(run_cohort(out, Silent(), write_page=cohort_world.slow_token, elsewhere=on_scheduler(address)))

    work = threading.Thread(target=run, daemon=True)
    work.start()
    deadline = time.monotonic() + TIME_LIMIT_S
    while sum((out / one).exists() for one in ids) < 2 and work.is_alive() and time.monotonic() < deadline:
        time.sleep(0.02)
    workers[0].kill()
    work.join(deadline - time.monotonic())
    assert not work.is_alive() and found, "not done in time"
    assert found[0].ended == {0: CASES - 1, 2: 1}
    runs = (out / "runs").read_text().split()
    committed = [(out / one / "token").read_text() for one in ids if (out / one / "token").exists()]
    assert len(committed) == len(set(committed)) == CASES - 1 and set(committed) <= set(runs)
    for folder in (out, tmp_path / "alone" / "out"):
        assert main(["batch", "merge", "--out", str(folder)]) == 0
    assert merged(out) == merged(tmp_path / "alone" / "out")
    for one in ids[:-1]:
        name = f"candidates/id={one}/candidates.parquet"
        assert (out / name).read_bytes() == (tmp_path / "alone" / "out" / name).read_bytes()


def test_no_scheduler_is_one_line(tmp_path, monkeypatch, capfd):
    """Nobody answers, or it is no address; limits are Dask's own."""
    write_cohort(tmp_path / "c", 2)
    out = tmp_path / "out"
    assert main(["batch", "plan", str(tmp_path / "c"), "--out", str(out), "--no-arm"]) == 0
    monkeypatch.setattr("puncture_twin.planning.batch.run.CONNECT_S", 0.5)
    for address in ("tcp://127.0.0.1:1", "nonsense://x"):
        with refused("no_scheduler"):
            run_cohort(out, Silent(), elsewhere=on_scheduler(address))
    with refused("dask_limits"):
        run_cohort(out, Silent(), limits=Limits(1000, None), elsewhere=on_scheduler("tcp://127.0.0.1:1"))
