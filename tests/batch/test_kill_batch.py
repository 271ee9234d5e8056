"""SIGKILL of workers and of the main process at random: after an undisturbed run nothing was lost.

Three kills here; ``make kill-batch`` makes two hundred.
"""

import os
import shutil
import signal
import time

import numpy as np
import psutil
import pytest
from cohort_world import run_here, write_patient
from kill_world import start

from puncture_twin.planning.batch.plan import WORK_PREFIX, read_plan_table, read_row
from puncture_twin.run_twin import main

KILLS = int(os.environ.get("BATCH_KILLS", "3"))
CASES = int(os.environ.get("BATCH_CASES", "6"))
STARTED_S = 60.0
"""So long a run may take to come to its work, on a busy machine."""


@pytest.fixture(scope="module")
def cohort(tmp_path_factory):
    """Patients whose targets differ, one of whom is refused; and the merged files of an undisturbed cohort."""
    here = tmp_path_factory.mktemp("kill")
    for number in range(CASES):
        target = f"position_mm = [{number % 10}.{number // 10},"
        write_patient(here / "c" / f"p{number:03d}", ("position_mm = [0.0,", target))
    (here / "c" / "p001" / "organ.stl").unlink()
    run_here(here / "c", here / "alone" / "out")
    assert main(["batch", "merge", "--out", str(here / "alone" / "out")]) == 0
    return here


def files(out):
    """Every merged file's bytes, and every result's but its timings."""
    names = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file())
    return {name: (out / name).read_bytes() for name in names if not name.endswith(("timings.json", "-lock"))}


def workers_of(process):
    try:
        found = psutil.Process(process.pid).children(recursive=True)
        return [one for one in found if "resource_tracker" not in " ".join(one.cmdline())]
    except psutil.Error:
        return []


def kill_one(process, out, rng):
    """Kill a worker, or the main process, some time after the work began; which of them, or None where it was over."""
    deadline = time.monotonic() + STARTED_S
    while process.poll() is None and not any(out.glob(f"{WORK_PREFIX}*/*")) and time.monotonic() < deadline:
        time.sleep(0.002)
    time.sleep(rng.uniform(0.0, 0.4))
    workers = workers_of(process)
    if process.poll() is not None or not workers:
        return None
    if rng.random() < 0.6:
        try:
            workers[rng.integers(len(workers))].kill()
        except psutil.Error:
            return None
        return "worker"
    process.send_signal(signal.SIGKILL)
    process.wait()
    _, alive = psutil.wait_procs(workers, timeout=30)
    assert not alive, "a worker outlives its main process"
    return "main"


def test_nothing_is_lost_by_kills(cohort):
    """Whoever is killed, and whenever: no half result, nothing left over, the same bytes in the end."""
    out, rng = cohort / "out", np.random.default_rng(16)
    killed = {"worker": 0, "main": 0}
    assert main(["batch", "plan", str(cohort / "c"), "--out", str(out), "--no-arm"]) == 0
    ids = [one.id for one in read_plan_table(out).cases]
    while sum(killed.values()) < KILLS:
        process = start(["batch", "run", "--out", out, "--jobs", "2"])
        while process.poll() is None and sum(killed.values()) < KILLS:
            one = kill_one(process, out, rng)
            if one is not None:
                killed[one] += 1
        process.kill()
        process.wait()
        done = [name for name in ids if read_row(out, name) is not None]
        assert done == [name for name in ids if (out / name).exists()], "half a result"
        for name in done if len(done) == len(ids) else done[: len(done) // 2]:
            shutil.rmtree(out / name)  # there is work to be killed at again
    print(killed)  # noqa: T201  # make kill-batch shows it
    assert main(["batch", "run", "--out", str(out), "--jobs", "2"]) == 1  # one is refused
    assert main(["batch", "merge", "--out", str(out)]) == 0
    assert not list(out.glob(f"{WORK_PREFIX}*"))
    assert files(out) == files(cohort / "alone" / "out")
