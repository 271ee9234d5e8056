"""A part of a cohort: every case in one part, neighbours together; SLURM's array says which."""

import re
import shlex
import subprocess
from itertools import product

import pytest
import typer
from places import ROOT
from refusals import refused

from puncture_twin.planning.batch.run import Part, parse_part, slurm_part
from puncture_twin.run_twin import app


def test_the_parts_are_the_whole():
    """In order, each case once, sizes within one of each other."""
    for count, parts in product([0, 1, 7, 100], [1, 2, 3, 7, 13]):
        items = list(range(count))
        found = [list(Part(number, parts).of(items)) for number in range(1, parts + 1)]
        assert [one for some in found for one in some] == items
        assert max(map(len, found)) - min(map(len, found)) <= 1


def array(task, count, first="0", **more):
    return {f"SLURM_ARRAY_TASK_{name}": value for name, value in dict(ID=task, COUNT=count, MIN=first, **more).items()}


def test_slurms_array_is_a_part():
    """From 0, from 1, in steps; nothing outside of an array. Of one with gaps it is not known which part a task is."""
    assert slurm_part(array("0", "8")) == Part(1, 8) and slurm_part(array("8", "8", "1")) == Part(8, 8)
    assert slurm_part(array("15", "4", "5", STEP="5")) == Part(3, 4) and slurm_part({}) is None
    for environment in (array("9", "8", "1"), array("6", "4", "5", STEP="5"), array("1", ""), array("a", "3")):
        with refused("bad_part"):
            slurm_part(environment)


@pytest.mark.parametrize("text", ["0/3", "4/3", "1/0", "1", "a/b", "-1/3", "1/3/5", "", "1/ 3"])
def test_what_is_no_part_is_refused(text):
    with refused("bad_part"):
        parse_part(text)


def test_the_array_of_the_page_is_a_script_that_runs_its_part():
    """Its directives are SLURM's, its indexes have no gap, and its line is one that the command line takes."""
    page = (ROOT / "docs" / "how-to" / "cohorts.md").read_text(encoding="utf-8")
    (script,) = re.findall(r"```sh\n(#!/bin/bash\n.*?)```", page, re.S)
    directives = dict(re.findall(r"^#SBATCH --([\w-]+)=(\S+)$", script, re.M))
    assert set(directives) == {"job-name", "array", "cpus-per-task", "mem", "time"}
    first, last = map(int, directives["array"].split("-"))
    count = str(last - first + 1)
    parts = [slurm_part(array(str(task), count, str(first))) for task in range(first, last + 1)]
    assert [part.text for part in parts] == [f"{n}/{count}" for n in range(1, last - first + 2)]
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)
    words = shlex.split(script.splitlines()[-1].replace("$SLURM_CPUS_PER_TASK", directives["cpus-per-task"]))
    assert words[:3] == ["run-twin", "batch", "run"]
    command = typer.main.get_command(app).commands["batch"].commands["run"]
    parsed = command.make_context("run", words[3:], resilient_parsing=True).params
    taken = (parsed["jobs"], parsed["memory_mb"], parsed["part"], str(parsed["out_dir"]))
    assert taken == (4, 3500, None, "/shared/cohort")
    memory_mb = int(directives["mem"].removesuffix("G")) * 1000
    assert parsed["jobs"] * parsed["memory_mb"] < memory_mb
