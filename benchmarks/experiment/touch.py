"""Tip touch: bias, speed and force of every touch of the embedded carton, and how long one takes."""

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.experiment.row import Row
from puncture_twin.meshes import folder
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.selection.choice import Choice
from puncture_twin.twin.jobs.experiment.touch_job import touch_case

CHOICE = Choice(angles=(np.radians(18.0), np.radians(232.0)))


def rows() -> list[Row]:
    """Every demand on a touch, over three truths."""
    context = prepare(folder() / "carton" / "case_m.toml")
    with tempfile.TemporaryDirectory() as out:
        found = [touch_case(context, Path(out) / str(seed), CHOICE, seed) for seed in range(3)]
    touches = [touch for run in found for touch in run.touched.readings]
    seconds = sum(run.touched.seconds for run in found) / len(touches)
    return [
        Row.at_most("tip behind the marker's face, largest, mm", max(abs(one.bias_mm) for one in touches), 0.03),
        Row.at_most("speed when felt, largest, mm/s", max(one.speed_mm_s for one in touches), 2.0),
        Row.at_most("force on the needle, largest, N", max(one.force_n for one in touches), 2.0),
        Row("seconds a touch, home to home", f"{seconds:.1f}", "", True),
        Row("expected error at the target, best poses, mm", f"{found[0].plan.expected_mm:.3f}", "", True),
        Row("the same, worst poses, mm", f"{found[0].plan.worst_mm:.3f}", "", True),
    ]
