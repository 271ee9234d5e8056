"""What a cohort costs: ``python -m benchmarks.cohort [--cases 10000] [--only overhead,targets,workers,many]``.

- overhead: a case of ``batch run`` in a warm worker against the library in a loop, on small patients;
- targets: a second target of the same patient against the first (the embedded abdomen), cold and warm, organs alone;
- workers: one worker against as many as there are cores;
- many: so many small cases on two workers, with the memory of the workers as it goes.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import trimesh

from puncture_twin.meshes import folder as meshes_folder
from puncture_twin.planning.base.cache.memory import Memory
from puncture_twin.planning.base.progress import Silent
from puncture_twin.planning.batch.plan import PlannedCase, read_plan_table
from puncture_twin.planning.batch.run import Request, run_cohort
from puncture_twin.planning.batch.run_case import MEMORY_BYTES, CaseTask, run_case
from puncture_twin.planning.batch.workers import NO_LIMITS, run_tasks
from puncture_twin.planning.case.options import case_options
from puncture_twin.planning.search.context import prepare
from puncture_twin.run_twin import main as command

CASE = """schema = 2
region = "other"
name = "small"
space = "LPS"
[target]
position_mm = [0.0, 0.0, 0.0]
structure = "organ"
[needle]
length_mm = 210.0
shaft_mm = 150.0
diameter_mm = 1.2
[search]
theta_deg = [0, 60]
beta_deg = [0, 270]
step_deg = 30.0
[[structure]]
name = "skin"
mesh = "skin.stl"
unit = "mm"
role = "skin"
[[structure]]
name = "organ"
mesh = "organ.stl"
unit = "mm"
role = "target"
[[structure]]
name = "rib"
mesh = "rib.stl"
unit = "mm"
role = "avoid"
margin_mm = 3.0
[end]
structures = 3
"""

BALLS = {"skin": (90.0, (0, 0, 0)), "organ": (20.0, (0, 0, 0)), "rib": (5.0, (40, 0, 40))}


def write_small(here: Path, count: int) -> Path:
    """A patient of three spheres, and a CSV with so many targets in it."""
    (here / "p").mkdir()
    for name, (radius, center) in BALLS.items():
        mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
        mesh.apply_translation(center)
        mesh.export(here / "p" / f"{name}.stl")
    (here / "p" / "case.toml").write_text(CASE)
    points = np.random.default_rng(7).uniform(-8.0, 8.0, (count, 3))
    lines = [f'p,"{x:.4f} {y:.4f} {z:.4f}"' for x, y, z in points]
    (here / "cohort.csv").write_text("\n".join(["case,target", *lines]) + "\n")
    return here / "cohort.csv"


def planned(here: Path, cohort: Path, *more: str) -> Path:
    """The folder of a planned cohort."""
    out = here / "out"
    shutil.rmtree(out, ignore_errors=True)
    assert command(["batch", "plan", str(cohort), "--out", str(out), "--no-arm", "--json", *more]) == 0
    return out


def seconds(work: Callable[[], object]) -> float:
    """Of some work."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def overhead(here: Path, count: int = 300) -> dict[str, float]:
    """Seconds a case: the library in a loop with the same memory, and a warm worker after its first case."""
    out = planned(here, write_small(here, count))
    rows = read_plan_table(out).cases
    memory = Memory(MEMORY_BYTES)

    def library() -> None:
        for row in rows:
            options = case_options(json.loads(row.options), where=row.case)
            prepare(row.path, arm=False, options=options, memory=memory).search()

    library()
    loop, loop_cpu = seconds(library) / count, cpu(library) / count
    tasks = [CaseTask(row, out, out) for row in rows]
    ends = run_tasks(tasks, 1, NO_LIMITS)
    next(ends)
    worker = seconds(lambda: list(ends)) / (count - 1)
    for row in rows:
        shutil.rmtree(out / row.id)
    done_cpu = cpu(lambda: [run_case(task, memory) for task in tasks]) / count
    return {
        "library_s": loop,
        "worker_s": worker,
        "overhead_ms": 1000 * (worker - loop),
        "library_cpu_s": loop_cpu,
        "case_cpu_s": done_cpu,
        "overhead_cpu_ms": 1000 * (done_cpu - loop_cpu),
    }


def targets(here: Path) -> dict[str, float]:
    """The first and the second target of the abdomen, processor seconds.

    Cold: workers that run one target, and both; the difference is the second's. Warm: in a process whose kernels are
    loaded, which has not seen the patient yet.
    """
    shutil.copytree(meshes_folder() / "abdomen", here / "a")
    text = (here / "a" / "case.toml").read_text()
    (here / "cohort.csv").write_text('case,target\na,\na,"{} {} {}"\n'.format(*near(text)))
    out = planned(here, here / "cohort.csv")
    first, second = read_plan_table(out).cases
    one, both = (worker_cpu(out, rows) for rows in ([first], [first, second]))
    memory = Memory(MEMORY_BYTES)
    run_case(CaseTask(first, out, out))
    shutil.rmtree(out / first.id)
    warm = [cpu(lambda row=row: run_case(CaseTask(row, out, out), memory)) for row in (first, second)]
    return {
        "cold_first_s": one,
        "cold_second_s": both - one,
        "cold_fraction": (both - one) / one,
        "warm_first_s": warm[0],
        "warm_second_s": warm[1],
        "warm_fraction": warm[1] / warm[0],
    }


def cpu(work: Callable[[], object]) -> float:
    """Processor seconds of some work in this process."""
    start = time.process_time()
    work()
    return time.process_time() - start


def worker_cpu(out: Path, rows: Sequence[PlannedCase]) -> float:
    """Processor seconds of one worker from its start to its end."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    list(run_tasks([CaseTask(row, out, out) for row in rows], 1, NO_LIMITS))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    for row in rows:
        shutil.rmtree(out / row.id)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def near(text: str) -> list[float]:
    """A point 2 mm beside a case's target."""
    line = next(one for one in text.splitlines() if one.startswith("position_mm"))
    point = json.loads(line.partition("=")[2].partition("#")[0])
    return [point[0] + 2.0, point[1], point[2]]


def workers(here: Path, count: int = 400) -> dict[str, float]:
    """Wall time of the same cohort with one worker and with one a core, start-up included."""
    cohort, found = write_small(here, count), {}
    for jobs in (1, len(os.sched_getaffinity(0))):
        out = planned(here, cohort)
        found[f"jobs_{jobs}_s"] = seconds(lambda out=out, jobs=jobs: run_cohort(out, Request(jobs=jobs), Silent()))
    return found


class Watch(Silent):
    """Notes the memory of this machine's workers as cases are done."""

    def __init__(self) -> None:
        self.resident_mb: list[tuple[int, float]] = []

    def count(self, stage: str, done: int, total: int, failed: int = 0) -> None:
        """Every tenth of the way."""
        if done % max(total // 10, 1) == 0:
            import psutil

            children = psutil.Process().children()
            held = [one.memory_info().rss for one in children if "spawn_main" in " ".join(one.cmdline())]
            self.resident_mb.append((done, round(max(held, default=0) / 1e6)))


def many(here: Path, count: int) -> dict[str, object]:
    """So many small cases on two workers."""
    cohort, watch, found = write_small(here, count), Watch(), {}
    found["plan_s"] = seconds(lambda: planned(here, cohort))
    out = here / "out"
    found["run_s"] = seconds(lambda: run_cohort(out, Request(jobs=2), watch))
    found["merge_s"] = seconds(lambda: command(["batch", "merge", "--out", str(out), "--json"]))
    return {"cases": count, **found, "largest_worker_mb": watch.resident_mb}


def main() -> None:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--only", default="overhead,targets,workers,many")
    arguments = parser.parse_args()
    figures = {"overhead": overhead, "targets": targets, "workers": workers}
    figures["many"] = lambda here: many(here, arguments.cases)
    for name in arguments.only.split(","):
        with tempfile.TemporaryDirectory() as here:
            print(json.dumps({name: figures[name](Path(here)), "machine": platform.platform()}), flush=True)


if __name__ == "__main__":
    main()
