"""The self-calibration's figures, measured: accuracy over 200 runs and more, coverage, choice of poses, speed.

.venv/bin/python -m benchmarks.axp_ybq             # everything, 200 runs: some minutes
.venv/bin/python -m benchmarks.axp_ybq --runs 20   # a look
"""

from __future__ import annotations

import argparse
import os
import platform
import time

import numpy as np
import scipy

from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibrate import calibrate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import N_PARAMETERS
from puncture_twin.twin.guidance.ultrasound.pose_choice import choose_poses, expected_tre_mm
from puncture_twin.twin.guidance.ultrasound.simulate import (
    SPEC_NOISE,
    PoseRanges,
    draw_truth,
    simulate_recording,
    with_noise,
)
from puncture_twin.twin.jobs.papers.axp_ybq import reproduce, reproduction_text, truth_estimate

SEED = 7
CANDIDATES = 300


def coverage(runs: int) -> None:
    """How often the 95 % region holds the truth, and how the predicted error compares with the real one."""
    print(
        f"\n95 % confidence regions of all parameters over {runs} runs ({2 * 100 * spread(0.95, runs):.1f} % is chance)"
    )
    print("poses    noise directions  lean   holds    TRE predicted  V deg")
    for n in (20, 30, 50):
        for told in (True, False):
            for directions, lean in ((False, 0.0), (True, 0.0), (True, 1.0)):
                cells = coverage_of(n, runs, told=told, directions=directions, lean_deg=lean)
                words = ("told" if told else "found", "used" if directions else "not used")
                print(f"{n:5d} {words[0]:>8s} {words[1]:>10s} {lean:5.1f} {100 * cells[0]:6.1f}% ", end="")
                print(f"{cells[1]:6.3f} {cells[2]:9.3f} {cells[3]:6.3f}", flush=True)


def coverage_of(n: int, runs: int, *, told: bool, directions: bool, lean_deg: float) -> tuple[float, ...]:
    """Share of regions that hold the truth, real and predicted rms error (mm), error of V (deg)."""
    rows = []
    for k in range(runs):
        rng = np.random.default_rng([SEED, n, k])
        recording, truth = simulate_recording(rng, n, ranges=PoseRanges(lean=float(np.radians(lean_deg))))
        held, _ = simulate_recording(rng, 100, truth, noise=None)
        found = calibrate(recording, noise=SPEC_NOISE if told else None, direction=directions)
        e = found.parameter_error(truth_estimate(truth))
        inside = e @ np.linalg.solve(found.covariance, e) <= found.region_limit()
        tre = np.mean(found.tre(held.A, held.B, held.P) ** 2)
        turned = np.degrees(np.linalg.norm(found.needle_direction_end2 - truth.direction_end2)) ** 2
        rows.append((float(inside), tre, np.mean(found.predicted_tre_mm(held.P, held.A) ** 2), turned))
    means = np.mean(rows, axis=0)
    return float(means[0]), *np.sqrt(means[1:]).tolist()


def spread(level: float, runs: int) -> float:
    """Standard deviation of a share."""
    return float(np.sqrt(level * (1 - level) / runs))


def pose_choice(runs: int) -> None:
    """Chosen poses against random ones: Cramer-Rao bound, and real errors of the weighted fit."""
    print(f"\nchosen poses against random ones ({runs} rooms; the prior is a drawing 6 deg and 15 mm off)")
    print("random chosen                   candidates  bound:random chosen  real:random chosen    ms")
    for ends, words in ((0.0, "anywhere in the ranges"), (0.8, "80 % at the ranges' ends")):
        for random, chosen in ((20, 12), (30, 18), (50, 30)):
            rows = [one_choice(np.random.default_rng([SEED, k, random]), random, chosen, ends) for k in range(runs)]
            rms = np.sqrt(np.mean(np.square(rows), axis=0))
            print(
                f"{random:6d} {chosen:6d} {words:>28s} {rms[0]:13.3f} {rms[1]:6.3f} {rms[2]:12.3f} {rms[3]:6.3f} ",
                end="",
            )
            print(f"{1e3 * rms[4]:5.0f}", flush=True)


def one_choice(rng: np.random.Generator, random: int, chosen: int, ends: float) -> tuple[float, ...]:
    """Errors in mm: bounds of random and chosen poses, real ones; and the seconds of choosing."""
    truth = draw_truth(rng)
    exact = truth_estimate(truth)
    candidates, _ = simulate_recording(rng, CANDIDATES, truth, noise=None, ranges=PoseRanges(at_ends=ends))
    held, _ = simulate_recording(rng, 200, truth, noise=None)
    step = np.zeros(N_PARAMETERS)
    step[:15] = rng.normal(0, np.repeat([0.1, 15, 0.1, 15, 15], 3))
    drawing = exact.moved(step)
    start = time.perf_counter()
    picked = candidates.subset(choose_poses(candidates, chosen, SPEC_NOISE, drawing))
    seconds = time.perf_counter() - start
    usual, _ = simulate_recording(rng, random, truth, noise=None)
    bounds = [expected_tre_mm(poses, SPEC_NOISE, exact, held) for poses in (usual, picked)]
    real = []
    for poses in (usual, picked):
        found = calibrate(with_noise(rng, poses, SPEC_NOISE), noise=SPEC_NOISE, direction=False, start=drawing)
        real.append(float(np.sqrt(np.mean(found.tre(held.A, held.B, held.P) ** 2))))
    return (*bounds, *real, seconds)


def speed() -> None:
    """Milliseconds for one calibration of 50 poses, all included: processor time of the thread, and wall time."""
    print("\none calibration of 50 poses, ms: median of 40, processor time and wall time")
    for told in (True, False):
        for directions in (False, True):
            took = []
            for k in range(40):
                recording, _ = simulate_recording(np.random.default_rng([SEED, k]), 50)
                start = time.thread_time(), time.perf_counter()
                calibrate(recording, noise=SPEC_NOISE if told else None, direction=directions)
                took.append((time.thread_time() - start[0], time.perf_counter() - start[1]))
            words = f"noise {'told' if told else 'found'}, directions {'used' if directions else 'not used'}"
            processor, wall = 1e3 * np.median(took, axis=0)
            print(f"  {words:35s} {processor:6.1f} {wall:6.1f}")


def main() -> None:
    """Print every table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    runs = parser.parse_args().runs
    versions = f"python {platform.python_version()}, numpy {np.__version__}, scipy {scipy.__version__}"
    print(f"{versions}, {platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    speed()
    print()
    print(reproduction_text(reproduce(None, runs)), flush=True)
    pose_choice(max(runs // 4, 5))
    coverage(runs)


if __name__ == "__main__":
    main()
