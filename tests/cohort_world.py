"""Cohorts for tests: the usual patient without a label map, a few directions each; and what goes wrong in workers."""

import json
import os
import signal
import time
import uuid

import pyarrow.parquet as pq
from case_world import ORGAN, SKIN, case_text, changed, structure, whole, write_balls

from puncture_twin.planning.base.cache.array_cache import NO_MEMORY
from puncture_twin.planning.batch.cohort import CohortCase
from puncture_twin.planning.batch.plan import planned, read_plan_table
from puncture_twin.planning.batch.run_case import CaseTask, run_case
from puncture_twin.planning.case.case_file import case_options
from puncture_twin.run_twin import main

SEARCH = "theta_deg = [0, 60]\nbeta_deg = [0, 270]\nstep_deg = 30.0"


def tiny_text(search=SEARCH, **keys):
    """A case whose structures are the usual meshes; a dozen directions."""
    return case_text(SKIN, ORGAN, structure("rib", "avoid", margin_mm=3.0), search=search, **keys)


def write_patient(folder, *changes, text=None):
    """A patient in a folder of its own, with (old, new) changes to the case; returns the case file."""
    folder.mkdir(parents=True)
    write_balls(folder)
    (folder / "case.toml").write_text(whole(changed(tiny_text() if text is None else text, *changes)))
    return folder / "case.toml"


def write_cohort(folder, count=3):
    """So many patients with targets 1 mm apart, the last of which is refused: its organ is not there."""
    for number in range(count):
        write_patient(folder / f"p{number}", ("position_mm = [0.0,", f"position_mm = [{number}.0,"))
    (folder / f"p{count - 1}" / "organ.stl").unlink()
    return folder


def plan_of(*paths, with_arm=False, **options):
    """Rows of a plan, as `batch plan` makes them."""
    chosen = case_options(options, where="test")
    return list(planned([CohortCase(path.parent.name, path, "", chosen) for path in paths], with_arm))


def task_of(row, out, **keys):
    """The task of a row; its drafts lie in a folder beside the results."""
    (out / "work").mkdir(parents=True, exist_ok=True)
    return CaseTask(row, out, out / "work", **keys)


def table_bytes(path, out, memory=NO_MEMORY, **options):
    """The candidates of a case as they are written, and the row beside them."""
    (row,) = plan_of(path, **options)
    end = run_case(task_of(row, out), memory)
    assert end.exit_code in (0, 1), end
    return (out / row.id / "candidates.parquet").read_bytes(), (out / row.id / "row.json").read_bytes()


def merged(out):
    """The rows of ``cases.parquet``, by case."""
    return {row["case"]: row for row in pq.read_table(out / "cases.parquet").to_pylist()}


def timings(folder):
    """Of one result."""
    return json.loads((folder / "timings.json").read_text())["batch"]


def die(context, found, folder):
    """A crash in compiled code: at the patient whose target is at 1 mm, and at the first try of every other one."""
    mark = folder.parent.parent / f"died-{context.case.target_ct[0]:g}"
    if context.case.target_ct[0] == 1.0 or not mark.exists():
        mark.write_text("")
        os.kill(os.getpid(), signal.SIGKILL)


def sleep_or_eat(context, found, folder):
    """Code that never comes to an end; at the patient whose target is at 1 mm it takes memory, and holds it."""
    if context.case.target_ct[0] == 1.0:
        held = bytearray(3_000_000_000)
        held[::4096] = b"x" * len(held[::4096])
    time.sleep(600)


def fail(context, found, folder):
    raise ZeroDivisionError("a bug")


def full(context, found, folder):
    """A disk that takes no more."""
    raise OSError(28, "No space left on device")


def run_here(cohort, out, most=None):
    """Plan a cohort and run its cases, or the first of them, in this process: no worker is started."""
    assert main(["batch", "plan", str(cohort), "--out", str(out), "--no-arm"]) == 0
    for row in read_plan_table(out).cases[:most]:
        run_case(task_of(row, out))


def slow_token(context, found, folder):
    """A case that takes a while, and writes down that it was run: one token a run, committed or not."""
    time.sleep(0.4)
    token = uuid.uuid4().hex
    (folder / "token").write_text(token)
    with (folder.parent.parent / "runs").open("a") as stream:
        stream.write(token + "\n")
