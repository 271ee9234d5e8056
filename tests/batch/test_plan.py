"""An id is the hash of inputs, options and program alone; each case is in one part, and SLURM's array says which."""

import re
import shlex
import shutil
import subprocess
from importlib.metadata import version
from itertools import product

import pytest
import typer
from cohort_world import plan_of, write_patient
from places import ROOT
from refusals import refused

from puncture_twin.planning.base.cache.source_stamp import closure
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.batch import plan as plans
from puncture_twin.planning.batch.plan import identified, program, read_plan_table, write_plan_table
from puncture_twin.planning.batch.run import Part, parse_part, slurm_part
from puncture_twin.run_twin import app


def id_of(path, **options):
    return plan_of(path, **options)[0].id


def test_the_same_bytes_have_the_same_id_wherever_they_lie(tmp_path):
    """In another folder, under another name of the case, through its folder, at another time."""
    path = write_patient(tmp_path / "a")
    shutil.copytree(path.parent, tmp_path / "b" / "c")
    assert id_of(path) == id_of(tmp_path / "b" / "c" / "case.toml") == id_of(tmp_path / "b" / "c")


def test_every_byte_and_option_decides(tmp_path, monkeypatch):
    """One bit of a mesh, a space in the case, an option, the arm, swapped files, the version: each gives another id."""
    path = write_patient(tmp_path / "a")
    rib, organ = (path.parent / f"{name}.stl" for name in ("rib", "organ"))
    ids = [id_of(path), *(id_of(path, margins={"rib": mm}) for mm in (3.0, 3.5)), id_of(path, with_arm=None)]
    content = bytearray(rib.read_bytes())
    content[100] ^= 1
    rib.write_bytes(content)
    ids.append(id_of(path))
    path.write_text(path.read_text() + " \n")
    ids.append(id_of(path))
    content = rib.read_bytes(), organ.read_bytes()  # the same bytes in other roles
    rib.write_bytes(content[1])
    organ.write_bytes(content[0])
    ids.append(id_of(path))
    monkeypatch.setattr(plans, "program", lambda: "9.9")
    assert len({*ids, id_of(path)}) == 8


def test_code_that_was_edited_between_two_releases_is_another_program(monkeypatch):
    """A row of the code before it stood for "safe" where the code after it says no."""
    before = program()
    assert before.startswith(f"{version('puncture-twin')}+")
    program.cache_clear()
    monkeypatch.setattr(plans, "source_stamp", lambda module: f"edited {module}")
    try:
        assert program() != before
    finally:
        program.cache_clear()
    decides = closure([str(ROOT / "planning" / "batch" / "run_case.py")])
    for one in ("anatomy/unseen", "clearance/fast_engine", "formats/dicom/structure_set", "search/constraints"):
        assert str(ROOT / "planning" / f"{one}.py") in decides


def test_a_case_that_cannot_be_read_is_planned_with_its_reason(tmp_path):
    """Without the folder in the text; mended, it has another id."""
    path = write_patient(tmp_path / "a")
    whole = id_of(path)
    (path.parent / "rib.stl").rename(path.parent / "away")
    (row,) = plan_of(path)
    assert row.refusal.startswith("case.toml: structure 'rib': file 'rib.stl' does not exist")
    assert str(tmp_path) not in row.refusal
    (path.parent / "away").rename(path.parent / "rib.stl")
    assert identified(row).id == whole != row.id
    assert "no such file" in plan_of(tmp_path / "gone" / "case.toml")[0].refusal


def test_a_plan_is_read_as_it_was_written(tmp_path):
    """And refused where it was edited, or is not there."""
    rows = plan_of(write_patient(tmp_path / "a"), tmp_path / "gone")
    with refused("no_batch_plan"):
        read_plan_table(tmp_path / "out")
    with writing(tmp_path / "out", "batch plan") as draft:
        write_plan_table(rows, draft.folder / "plan.parquet")
    assert list(read_plan_table(tmp_path / "out").cases) == rows
    path = tmp_path / "out" / "plan.parquet"
    path.write_bytes(path.read_bytes() + b" ")
    with refused("output_not_whole"):
        read_plan_table(tmp_path / "out")


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
