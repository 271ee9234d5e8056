"""What one straight segment of the approach costs, and what OMPL's call adds to it: a table.

    python -m benchmarks.approach_segments [--problems N]

The segments lead from home to the nearest goal of each problem of benchmarks/approach.py. "First" is the check as the
planner meets it, once; "again" the fastest of five. "Callback" is one call by OMPL of the planner's own validator with
a check that says at once that all is free: states to angles and back, and Python's frames. Processor time of this
thread, microseconds.
"""

from __future__ import annotations

import argparse
from time import thread_time

import numpy as np
from ompl import base as ob

from benchmarks.approach import Scene, scenes
from puncture_twin.planning.motion.rrt_connect import JointSpace, Limits, SegmentContact, _Validator

CALLS = 2000


def main() -> None:
    """Print the table, room by room."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=100)
    print("| room | segments, free | free: first | free: again | in contact: first | callback |")
    print("|---|---|---|---|---|---|", flush=True)
    for scene in scenes(parser.parse_args().problems):
        print(row(scene), flush=True)


def row(scene: Scene) -> str:
    """One room; medians."""
    check, times = scene.fast.segment_checker(), []
    check(*segment(*scene.problems[0]))  # compiled
    for problem in scene.problems:
        ends = segment(*problem)
        spent = [timed(check, ends) for _ in range(6)]
        times.append((check(*ends) is None, spent[0], min(spent[1:])))
    free = np.array([t[1:] for t in times if t[0]]).reshape(-1, 2)
    hit = [t[1] for t in times if not t[0]]
    first, again = (f"{value:.0f}" for value in np.median(free, axis=0)) if len(free) else ("-", "-")
    blocked = f"{np.median(hit):.0f}" if hit else "-"
    return f"| {scene.name} | {len(times)}, {len(free)} | {first} | {again} | {blocked} | {callback(scene):.1f} |"


def segment(home: np.ndarray, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """From home to the nearest goal."""
    return home, goals[np.argmin(np.linalg.norm(goals - home, axis=1))]


def timed(check: SegmentContact, ends: tuple[np.ndarray, np.ndarray]) -> float:
    """Microseconds of one check."""
    begin = thread_time()
    check(*ends)
    return 1e6 * (thread_time() - begin)


def callback(scene: Scene) -> float:
    """Microseconds of one call by OMPL, without the check."""
    home, goals = scene.problems[0]
    limits = Limits(scene.fast.model.joint_limits, CALLS)
    space = JointSpace(limits.bounds)
    validator = _Validator(space.information, lambda start, end: None, home, goals, limits)
    space.set_up(validator)
    information: ob.SpaceInformation = space.information
    start, end = space.state(home), space.state(goals[0])
    begin = thread_time()
    for _ in range(CALLS):
        information.checkMotion(start, end)
    return 1e6 * (thread_time() - begin) / CALLS


if __name__ == "__main__":
    main()
