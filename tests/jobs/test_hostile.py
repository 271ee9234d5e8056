"""Hostile inputs, each with its story in hostile/cases.toml: one line, no traceback, no hang, no gigabytes."""

import json
import multiprocessing
import os
import subprocess
import sys
import tomllib

import pytest
from hostile.makers import MAKERS
from places import TESTS

from puncture_twin.planning.base.processes import worker_count, working

HERE = TESTS
CASES = tomllib.loads((HERE / "hostile" / "cases.toml").read_text())["case"]
SECONDS, MEGABYTES = 10, 1000  # bounds of a case that states none, generous: the machine may be shared
SPAN_MEGABYTES = 6000
"""Address space beyond what the imports hold: libraries reserve more than they use. It protects the machine; what is
used is compared afterwards."""
LONGEST_LINE = 1500
PROGRESS = ("stage: ", "anatomy: ")  # how lines of progress begin, which a slow machine shows before the refusal


@pytest.fixture(scope="module")
def runner():
    here = HERE.parent
    path = os.pathsep.join([str(here), str(HERE), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(HERE / "hostile" / "runner.py")]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=here
    ) as process:

        def run(task):
            process.stdin.write(json.dumps(task) + "\n")
            process.stdin.flush()
            return json.loads(process.stdout.readline())

        yield run
        process.stdin.close()


def task_of(case, folder, out):
    task = {"seconds": case.get("seconds", SECONDS), "megabytes": SPAN_MEGABYTES}
    if "reader" in case:
        return {**task, "reader": case["reader"], "path": str(folder / case["file"])}
    longer = {word: text[0] * int(text[2:]) for word, text in case.get("replace", {}).items()}
    words = [longer.get(word, word).replace("{folder}", str(folder)).replace("{out}", str(out)) for word in case["run"]]
    for word, digits in case.get("bytes", {}).items():
        words = [one.replace(word, os.fsdecode(bytes.fromhex(digits))) for one in words]
    return {**task, "argv": words}


def said_of(done, out):
    """The lines of a refusal: those of stderr without progress; nothing is written."""
    assert not out.exists() or not any(out.iterdir())
    return [line for line in done["err"].splitlines() if not line.startswith(PROGRESS)]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case["name"])
def test_a_hostile_input_costs_one_line(case, runner, tmp_path):
    """The exit code and the line that the story's case states, in time and memory."""
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    MAKERS[case["make"]](folder)
    done = runner(task_of(case, folder, out))
    assert done["exit"] == case.get("exit", 2), done
    assert case["expect"] in done["err"]
    assert done["megabytes"] < case.get("megabytes", MEGABYTES)
    if done["exit"] == 2:
        lines = said_of(done, out)
        assert len(lines) == 1
        assert len(lines[0]) <= LONGEST_LINE
        assert lines[0].isprintable()
        assert "allowed: " in lines[0]


def test_every_maker_has_a_story():
    assert {case["make"] for case in CASES} == set(MAKERS)
    assert len({case["name"] for case in CASES}) == len(CASES)
    assert all(len(case["story"]) > 3 for case in CASES)


def test_a_million_jobs_are_as_many_processes_as_cores():
    """``place --jobs 1000000`` started 3,136 processes before it was stopped; the answers stay in order."""
    cores = len(os.sched_getaffinity(0))
    assert [worker_count(1_000_000, pieces) for pieces in (1_000_000, 1, 0)] == [cores, 1, 1]
    with working(1_000_000, 400) as work:
        assert list(work(abs, range(-400, 0), chunksize=48)) == list(range(400, 0, -1))
        assert len(multiprocessing.active_children()) <= cores
