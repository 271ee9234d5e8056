"""Visual servoing by the numbers: figures to reach, sensitivity, and how far from the statistical optimum.

    python -m benchmarks.servo [--seeds 20] [--jobs 2] [figures] [sensitivity] [optimum] [optimum-pixels]

Each row is a whole study: so many rooms drawn, calibrated from rendered pictures, mapped and servoed to 16 targets.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from functools import partial
from typing import Any

import numpy as np

from benchmarks.optimum_trial import OptimumTrial, optimum_trial
from benchmarks.servo_variants import pixel_detector, varied
from puncture_twin.meshes import folder
from puncture_twin.planning.base.processes import process_pool
from puncture_twin.twin.guidance.stereo.detection import Detector, image_detector
from puncture_twin.twin.guidance.stereo.experiment import Statistics, run_trials, statistics
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase, load_servo_case
from puncture_twin.twin.guidance.stereo.session import DetectorOf
from puncture_twin.twin.guidance.stereo.stereo_workcell import StereoWorkcell

PIXEL_PX = 0.02
"""Error of a ball's centre, per axis, where the pictures are left out: what they give at noise 2."""

PAPER_MARKER_MM = 1.5
"""Markers read as badly as in the paper: its mapping errs by 1.06 mm."""

HEAD = (
    f"{'study':34s} {'stereo':>13s} {'map':>5s} {'exp':>5s} {'before':>6s} {'after':>6s} {'a/m':>6s} "
    f"{'servo-only':>13s} {'steps':>5s} {'not conf.':>9s} {'refused':>7s}"
)


def row(name: str, ours: Statistics) -> str:
    """One study in a line."""
    return (
        f"{name:34s} {ours.stereo_mean:6.3f} {ours.stereo_max:6.3f} {ours.mapping_rms:5.2f} "
        f"{ours.expected_tre_rms:5.2f} {ours.before_mean:6.2f} {ours.after_mean:6.3f} {ours.after_over_mapping:6.3f} "
        f"{ours.servo_only_mean:6.3f} {ours.servo_only_max:6.3f} {ours.median_steps:5.1f} "
        f"{100 * ours.not_confirmed:7.1f} % {ours.refused:7d}"
    )


def study(name: str, case: ServoCase, seeds: int, jobs: int) -> Statistics:
    """Run and print one."""
    ours = statistics(run_trials(case, range(seeds), jobs=jobs))
    print(row(name, ours), flush=True)
    return ours


def figures(case: ServoCase, seeds: int, jobs: int) -> None:
    """The figures to reach, each beside what was measured."""
    print(f"figures: {seeds} seeds x {len(case.targets.names)} targets; mean max; mm\n{HEAD}")
    near = study("UR-like arm", case, seeds, jobs)
    as_paper = varied(case, errors={"marker_mm": PAPER_MARKER_MM})
    paper = study("UR-like arm, markers as the paper's", as_paper, seeds, jobs)
    checks = (
        ("stereo mean", near.stereo_mean, 0.05),
        ("stereo max", near.stereo_max, 0.10),
        ("servo-only mean", near.servo_only_mean, 0.10),
        ("servo-only max", near.servo_only_max, 0.20),
        ("after / mapping, markers as the paper's", paper.after_over_mapping, 1.02),
        ("after / mapping, markers of 0.3 mm", near.after_over_mapping, 1.02),
        ("median of steps", near.median_steps, 2.0),
        ("not confirmed", near.not_confirmed, 0.02),
    )
    for what, got, limit in checks:
        print(f"  {what:40s} {got:7.4f}  limit {limit:5.2f}  {'reached' if got <= limit else 'NOT reached'}")


def sensitivity(case: ServoCase, seeds: int, jobs: int) -> None:
    """One thing worse at a time."""
    print(f"sensitivity: {seeds} seeds x {len(case.targets.names)} targets\n{HEAD}")
    changes: tuple[tuple[str, dict[str, dict[str, Any]]], ...] = (
        ("as the case", {}),
        ("four frames a look", {"servo": {"frames": 4}}),
        ("lens k1 -0.1 not modelled", {"cameras": {"model_distortion": False}}),
        ("lens k1 -0.3 not modelled",
         {"cameras": {"model_distortion": False, "distortion": [-0.3, 0.02, 0.0005, -0.0005]}}),
        ("noise 6 grey levels", {"cameras": {"noise_grey": 6.0}}),
        ("baseline 200 mm", {"cameras": {"baseline_mm": 200.0}}),
        ("backlash 0.3 deg", {"errors": {"backlash_deg": 0.3}}),
        ("repeatability 0.02 deg", {"errors": {"repeatability_deg": 0.02}}),
        ("15 % of the ball hidden", {"cameras": {"occlusion": 0.15}}),
        ("30 % of the ball hidden", {"cameras": {"occlusion": 0.30}}),
        ("a lamp instead of diffuse light", {"cameras": {"light": "lamp"}}),
        ("Hough's circle alone", {"cameras": {"centre": "hough"}, "servo": {"tolerance_mm": 0.4}}),
    )  # fmt: skip
    for name, changed in changes:
        study(name, varied(case, **changed), seeds, jobs)


def pixels_alone(room: StereoWorkcell, rng: np.random.Generator) -> Detector:
    """True pixels with normal errors of ``PIXEL_PX``."""
    return pixel_detector(room, PIXEL_PX, rng)


def optimum(case: ServoCase, seeds: int, jobs: int, detector_of: DetectorOf = image_detector) -> None:
    """Chain and joint estimate against the Cramer-Rao bound, the servo closed over each."""
    for frames in (1, 4):
        print(f"optimum, {frames} frame{'s' if frames > 1 else ''} a look: {seeds} seeds; rms, mm; ratio to the bound")
        print(f"  {'estimate':8s} {'ball':>14s} {'target':>14s} {'target - ball':>14s} {'after, servo':>14s}")
        for estimate in ("chain", "joint"):
            variant = varied(case, servo={"estimate": estimate, "frames": frames})
            with process_pool(jobs, seeds) as pool:
                trials = list(pool.map(partial(optimum_trial, variant, detector_of=detector_of), range(seeds)))
            print(f"  {estimate:8s} " + " ".join(ratio(trials, name) for name in ("ball", "target", "offset", "after")))


def ratio(trials: list[OptimumTrial], name: str) -> str:
    """Rms error of one quantity and its ratio to its bound."""
    errors = np.concatenate([getattr(one, f"{name}_mm") for one in trials])
    floor = "offset" if name == "after" else name
    bounds = np.concatenate([getattr(one, f"{floor}_bound_mm") for one in trials])
    rms, least = np.sqrt(np.mean(np.square(errors))), np.sqrt(np.mean(np.square(bounds)))
    return f"{rms:7.3f} {rms / least:6.2f}"


PARTS = {
    "figures": figures,
    "sensitivity": sensitivity,
    "optimum": optimum,
    "optimum-pixels": partial(optimum, detector_of=pixels_alone),
}
"""What can be asked for; the last leaves the pictures out: errors of the pixels as the bound assumes them."""


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=["figures", "sensitivity", "optimum"])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2)
    asked = parser.parse_args()
    if unknown := set(asked.parts) - set(PARTS):
        parser.error(f"{', '.join(sorted(unknown))}: not known; there are: {', '.join(PARTS)}")
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # for the processes that are started: one thread each
    case, start = load_servo_case(folder() / "head"), time.perf_counter()
    print(f"numpy {np.__version__}, Python {platform.python_version()}, {os.cpu_count()} cores, {asked.jobs} processes")
    for part in asked.parts:
        PARTS[part](case, asked.seeds, asked.jobs)
        print(f"  {time.perf_counter() - start:.0f} s\n", flush=True)


if __name__ == "__main__":
    main()
