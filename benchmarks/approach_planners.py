"""Which of OMPL's planners and settings finds the approach beside a gantry: a table.

    python -m benchmarks.approach_planners [--problems N]

The problems are those of benchmarks/approach.py beside a gantry. Each planner gets one run of at most 4,000 samples
(how often it asks whether to stop) within half a turn of home and goals, and the product's shortcuts, with their
clearance; times are CPU seconds.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from time import process_time
from typing import Any
from unittest.mock import patch

import numpy as np
from ompl import geometric as og

from benchmarks.approach import Scene, scenes
from puncture_twin.planning.motion import rrt_connect, rrt_connect as joint_space, shortest
from puncture_twin.planning.motion.path_check import path_length
from puncture_twin.planning.motion.rrt_connect import CLEARANCE_MM, Limits, connect
from puncture_twin.planning.motion.shortest import NEAR_RAD, Task

SAMPLES = 4000
OF_RRT_CONNECT = ((0.5, 1.0), (0.5, 2.0), (1.0, 1.0), (1.0, 2.0), (1.0, 4.0), (2.0, 2.0))
"""Longest branch, rad, and what the wrist's angles are divided by."""

NEVER = 10**9
"""Other planners do not grow two trees: none of theirs is taken to be shut in."""


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=33)
    scene = list(scenes(3 * parser.parse_args().problems))[-1]
    print(
        "| planner | longest branch | wrist over | solved | CPU ms, median | segments, median | rad, median of solved |"
    )
    print("|---|---|---|---|---|---|---|", flush=True)
    for kind in (og.RRTConnect, og.LBKPIECE1, og.BKPIECE1, og.KPIECE1, og.BITstar):
        settings = OF_RRT_CONNECT if kind is og.RRTConnect else ((1.0, 2.0),)
        for range_rad, wrist in settings:
            print(row(scene, kind, range_rad, wrist), flush=True)


def row(scene: Scene, kind: Callable[..., Any], range_rad: float, wrist: float) -> str:
    """One planner on all problems."""

    def planner(information: Any) -> Any:
        made = kind(information)
        if hasattr(made, "setRange"):
            made.setRange(range_rad)
        return made

    divided = (joint_space.JointSpace.__init__.__defaults__, joint_space.angles_of.__defaults__)
    joint_space.JointSpace.__init__.__defaults__ = joint_space.angles_of.__defaults__ = (wrist,)
    try:
        with patch.object(rrt_connect, "_planner", planner), patch.object(rrt_connect, "STALLED", NEVER):
            found = [one(scene, number) for number in range(len(scene.problems))]
    finally:
        joint_space.JointSpace.__init__.__defaults__, joint_space.angles_of.__defaults__ = divided
    seconds, segments, lengths = np.array(found).T
    solved = np.isfinite(lengths)
    length = f"{np.median(lengths[solved]):.2f}" if solved.any() else "-"
    reach = f"{range_rad} rad" if hasattr(kind, "setRange") else "-"
    return (
        f"| {kind.__name__} | {reach} | {wrist:g} | {solved.sum()} of {len(solved)} | {1e3 * np.median(seconds):.0f} "
        f"| {np.median(segments):.0f} | {length} |"
    )


def one(scene: Scene, number: int) -> tuple[float, int, float]:
    """CPU seconds, segments checked, and the path's length; NaN where there is none."""
    home, goals = scene.problems[number]
    check, count = scene.fast.segment_checker(), [0]

    def contact_of(start: np.ndarray, end: np.ndarray) -> Any:
        count[0] += 1
        return check(start, end)

    task = Task(scene.fast.model.joint_limits, contact_of, home, goals)
    limits, clear_of = Limits(shortest._box(task, NEAR_RAD), SAMPLES), scene.fast.segment_checker(CLEARANCE_MM)
    begin = process_time()
    found = connect(contact_of, home, goals, limits, seed=50 * number, clear_of=clear_of)
    spent = process_time() - begin
    return spent, count[0], float("nan") if found.waypoints is None else path_length(found.waypoints)


if __name__ == "__main__":
    main()
