"""Tip touch on the embedded carton: bias, speed, force, seconds; and the pivot calibration of a tip."""

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.experiment.row import Row
from puncture_twin.meshes import folder
from puncture_twin.planning.geometry.rigid import exp_rotation, pose
from puncture_twin.planning.search.choice import Choice
from puncture_twin.planning.search.context import prepare
from puncture_twin.twin.guidance.ct.pivot import pivot_calibration
from puncture_twin.twin.jobs.experiment.pivot_job import pivot_tour
from puncture_twin.twin.jobs.experiment.touch_job import touch_case

TIP, PLACE = np.array([1.5, -0.8, 210.0]), np.array([350.0, 60.0, 40.0])
CHOICE = Choice(angles=(np.radians(18.0), np.radians(232.0)))


def rows() -> list[Row]:
    """Every demand on a touch, over three truths."""
    context = prepare(folder() / "carton" / "case_m.toml")
    with tempfile.TemporaryDirectory() as out:
        found = [touch_case(context, Path(out) / str(seed), CHOICE, seed) for seed in range(3)]
        executed = [pivot_tour(context, Path(out) / f"pivot{seed}", 8, None, seed) for seed in range(3)]
    return [*_touches(found), *_pivots(), *_executed(executed)]


def _touches(found):
    touches = [touch for run in found for touch in run.touched.readings]
    seconds = sum(run.touched.seconds for run in found) / len(touches)
    return [
        Row.at_most("tip behind the marker's face, largest, mm", max(abs(one.bias_mm) for one in touches), 0.03),
        Row.at_most("speed when felt, largest, mm/s", max(one.speed_mm_s for one in touches), 2.0),
        Row.at_most("force on the needle, largest, N", max(one.force_n for one in touches), 2.0),
        Row("seconds a touch, home to home", f"{seconds:.1f}", "", True),
        Row("expected tip error, best poses, mm", f"{found[0].plan.expected_mm:.3f}", "", True),
        Row("the same, worst poses, mm", f"{found[0].plan.worst_mm:.3f}", "", True),
    ]


def _pivots():
    """Touch noise .1 mm, tilts up to 45 degrees, 400 calibrations each."""
    rng, found = np.random.default_rng(1), []
    for count in (4, 8, 20):
        pivots = [pivot_calibration(pivot_poses(count, rng), 0.1) for _ in range(400)]
        rms = float(np.sqrt(np.mean([np.sum((pivot.tip_flange - TIP) ** 2) for pivot in pivots])))
        square = float(np.mean([pivot.residual_mm**2 for pivot in pivots])) / (0.01 * (3 * count - 6) / count)
        demand, met = ("<= 0.2", rms <= 0.2) if count >= 8 else ("", True)
        found.append(Row(f"pivot, {count} poses: tip, rms, mm", f"{rms:.3f}", demand, met))
        found.append(Row.between(f"pivot, {count} poses: residual^2 over noise^2 (3n - 6) / n", square, 0.9, 1.1))
    return found


def _executed(runs):
    """Eight poses touched in the twin, three truths: the tip's error and the residual beside the declared ones."""
    error = float(np.sqrt(np.mean([run.error_mm**2 for run in runs])))
    residual = float(np.sqrt(np.mean([run.found.pivot.residual_mm**2 for run in runs])))
    expected, left = runs[0].expected_error_mm, runs[0].found.pivot.expected_whole_mm
    return [
        Row("pivot executed, 8 poses, 3 arms: tip, rms, mm", f"{error:.3f}", f"{expected:.3f} expected", True),
        Row("the same: residual, rms, mm", f"{residual:.3f}", f"{left:.3f} expected", True),
    ]


def pivot_poses(count, rng):
    """Flanges that put the tip on one place but for a touch's noise, tilted to all sides, at any roll."""
    tilt, side = np.radians(45.0) * np.sqrt(rng.uniform(0.3, 1, count)), rng.uniform(0, 2 * np.pi, count)
    lean = tilt[:, None] * np.column_stack([np.cos(side), np.sin(side), np.zeros(count)])
    roll = np.column_stack([np.zeros((count, 2)), rng.uniform(-1, 1, count)])
    R = exp_rotation(lean) @ np.diag([1.0, -1.0, -1.0]) @ exp_rotation(roll)
    return pose(R, PLACE + rng.normal(0, 0.1, (count, 3)) - R @ TIP)
