"""SIGKILL at random moments: a folder then holds the old set, the new one, or one that every reader refuses.

``make kill`` runs every command as a whole, with more kills, and prints the table of docs/reference/validation.md.
"""

import os
import shutil
import signal
import sys
import time
from collections import Counter

import pytest
from kill_world import PLACE, SELFCAL, coarse_cases, generator, kill_while_writing, said, start, state_of, temporaries

from puncture_twin.meshes import folder
from puncture_twin.planning.base.files import sha256
from puncture_twin.planning.base.output.manifest import problems, read_manifest
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.provenance import Input
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import ANSWER_IS_NO, OK

KILLS = int(os.environ.get("KILLS", "2"))
"""Of a command; ten times as many of a writer: a mix that one kill in ten leaves is seen in 7 runs of 8."""
ALL = "KILLS" in os.environ
TRIES = 3  # runs a kill at most: one that ends before it is killed does not count

needs_time = pytest.mark.skipif(not ALL, reason="make kill")

WRITTEN = {
    "search": ("certificate.json", "candidates.parquet", "map.png", "scene.png", "slices.png", "report.html"),
    "export plan.csv": ("plan.csv",),
    "batch merge": ("candidates/id=1/a.parquet", "candidates/id=2/a.parquet", "cases.parquet", "cohort.html"),
    "touch": ("touch.csv", "touch.json"),
}
"""Many files, one, folders, and two; sizes do not matter, so a few hundred bytes stand for each."""


def write_generation(out, command, generation):
    """What the command writes, each file saying in which run it was written; some runs write a file less."""
    inputs = (Input("case", "case.toml", str(generation)),)
    with writing(out, command, inputs=inputs) as draft:
        for name in WRITTEN[command][: None if generation % 2 else -1] or WRITTEN[command]:
            path = draft.folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{generation} " * 200)


def generations(out, command):
    """The runs from which files of a command's entry come; every one of them with the bytes that are listed."""
    manifest = read_manifest(out)
    if manifest is None or command not in manifest.entries:
        return set()
    assert [line for line in problems(out) if "left over" not in line] == []
    entry = manifest.entries[command]
    return {(out / name).read_text().split()[0] for name in entry.files} | {one.sha256 for one in entry.inputs}


@pytest.mark.parametrize("command", WRITTEN)
def test_a_writer_killed_at_random_leaves_no_mix(command, tmp_path):
    """Run after run of the command's writing, killed within milliseconds: all that passes is of one run."""
    rng, generation = generator(command), 0
    for _ in range(KILLS * 10):
        child = os.fork()
        if child == 0:
            for number in range(generation + 1, generation + 10_000):
                write_generation(tmp_path, command, number)
            os._exit(0)
        time.sleep(rng.uniform(0.002, 0.03))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        assert len(generations(tmp_path, command)) <= 1
        generation += 20_000 + int(rng.integers(2))
        write_generation(tmp_path, command, generation)
        assert generations(tmp_path, command) == {str(generation)}
        assert problems(tmp_path) == () and temporaries(tmp_path) == []


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    here = tmp_path_factory.mktemp("kill")
    return here, coarse_cases(here)


@pytest.fixture(scope="module")
def plans(world):
    here, cases = world
    for case in cases:
        assert main(["plan", str(case), "--out", str(here / f"planned-{case.parent.name}")]) == OK
    return [here / f"planned-{case.parent.name}" / "plan.json" for case in cases]


def kills(command, entry, arguments, inputs, out):
    """Kill a command again and again, while it runs, and run it to its end after each; its inputs tell the sets."""
    rng, counts, tells = generator(command), Counter(), list(map(sha256, inputs))
    assert main([*map(str, arguments[0]), "--out", str(out)]) in (OK, ANSWER_IS_NO)
    old = 0
    for _ in range(TRIES * KILLS):
        new = 1 - old
        process = start([*arguments[new], "--out", out])
        running = kill_while_writing(process, out, rng)
        left = state_of(out, entry, tells[old], tells[new])
        assert running or left == "new"
        counts[left] += running
        assert main([*map(str, arguments[new]), "--out", str(out)]) in (OK, ANSWER_IS_NO)
        assert state_of(out, entry, tells[old], tells[new]) == "new"
        assert problems(out) == () and temporaries(out) == []
        old = new
        if sum(counts.values()) == KILLS:
            break
    assert counts.total() > 0
    sys.stdout.write(said(command, counts) + "\n")


OF_A_CASE = {
    "search": ["search", "--no-arm"],
    "plan": ["plan"],
    "scan": ["scan", "--spacing", "5", "--pixel", "2"],
    "touch": ["touch", "--theta", "18", "--beta", "232"],
    "pivot": ["pivot", "--poses", "4"],
    "markers": ["markers", "--propose", "4"],
    "sweep": ["rehearse", "--theta", "18", "--beta", "232", "--sweep", "--to", "19,231"],
}
"""Entry to the command's words."""


@pytest.mark.parametrize("entry", ["search", *(pytest.param(one, marks=needs_time) for one in list(OF_A_CASE)[1:])])
def test_a_command_killed_at_random(entry, world, tmp_path):
    verb, *options = OF_A_CASE[entry]
    kills(entry, entry, [[verb, case, *options] for case in world[1]], world[1], tmp_path / "out")


def two_of(folder_of, file, changes, here):
    """Two copies of an embedded folder whose case file differs by what is added or replaced."""
    for name, (old, new) in zip("ab", changes, strict=True):
        shutil.copytree(folder_of, here / name)
        text = (here / name / file).read_text()
        (here / name / file).write_text(text.replace(old, new) if old else text + new)
    return [here / name / file for name in "ab"]


STEPS = [("step_deg = 2.0", f"step_deg = {step}") for step in ("15.0", "18.0")]
OF_PLANS = {"rehearse": ("rehearse", ["rehearse"]), "export": ("export plan.csv", ["export", "--format", "csv"])}
OWN_CASES = {
    "place": (folder() / "abdomen", "case.toml", STEPS, ["place", "--full"]),
    "servo": (folder() / "head", "servo.toml", [("", "# a\n"), ("", "# b\n")], ["servo"]),
    "selfcal": (None, "selfcal.toml", [("seed = 3", f"seed = {seed}") for seed in (3, 4)], ["selfcal", "--seeds", "1"]),
}
"""Command to its entry and words, of a plan; and of two cases of its own: folder, file, and in what they differ."""


@needs_time
@pytest.mark.parametrize("command", OF_PLANS)
def test_a_command_on_a_plan_killed_at_random(command, world, plans, tmp_path):
    entry, (verb, *options) = OF_PLANS[command]
    runs = [[verb, plan, *options] for plan in plans]
    if command == "rehearse":
        runs = [[*run, "--case", case] for run, case in zip(runs, world[1], strict=True)]
    kills(command, entry, runs, plans, tmp_path / "out")


@needs_time
@pytest.mark.parametrize("command", OWN_CASES)
def test_a_command_on_a_case_of_its_own_killed_at_random(command, tmp_path):
    source, file, changes, (verb, *options) = OWN_CASES[command]
    if source is None:
        source = tmp_path / "small"
        source.mkdir()
        (source / file).write_text(SELFCAL)
    cases = two_of(source, file, changes, tmp_path)
    if command == "place":
        for case in cases:
            case.write_text(case.read_text() + PLACE)
    kills(command, command, [[verb, case, *options] for case in cases], cases, tmp_path / "out")
