"""How fast the approach is planned: seeded problems in a free room, beside a body on a table, and beside a CT gantry.

    python benchmarks/approach.py [--problems N] [--quick] [--fast-only]

Each problem is planned twice with the same code and seed: with the fast checker, and with FCL alone judging segments
at samples (not with --fast-only: that takes most of the time). Every path of the fast one is checked once more by FCL
alone, twice as densely as when it was planned. Times are CPU seconds of this process; building the checkers and
measuring the clearance are timed apart.
"""

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.kinematics import DEFAULT_SPEEDS, TipLimit, flange_pose, slowed
from puncture_twin.planning.arm.tool import Box, Tool, gantry_boxes
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.workcell import ARM_PADDING_MM, case_boxes, case_tool, home_configuration
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.motion import approach
from puncture_twin.planning.motion.approach import FINER, RESOLUTION_RAD, Approach, plan_approach
from puncture_twin.planning.motion.follow import MAX_JERK, follow
from puncture_twin.planning.motion.path_check import dense_states, least_clearance, path_length
from puncture_twin.planning.reach.reach import approach_goals
from puncture_twin.planning.reach.survey import ReachRequest
from puncture_twin.planning.search.context import CaseContext, prepare

STANDOFF_MM = 100.0
FAST, SLOW = "fast", "FCL alone"


@dataclass
class Scene:
    """A room with both checkers, and problems in it."""

    name: str
    fast: FastChecker
    slow: CellChecker
    built_s: tuple[float, float, float]
    boxes: tuple[Box, ...]
    patient: TriangleMesh | None
    problems: list[tuple[np.ndarray, np.ndarray]]


@dataclass
class Tally:
    """What one checker did in one scene."""

    solve_s: list[float] = field(default_factory=list)
    total_s: list[float] = field(default_factory=list)
    rad: list[float] = field(default_factory=list)
    straight_rad: list[float] = field(default_factory=list)
    most_turned_rad: float = 0.0
    tip_mm: list[float] = field(default_factory=list)
    drive_s: list[float] = field(default_factory=list)
    straight_s: list[tuple[float, float, float]] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)


def main() -> None:
    """Run all of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problems", type=int, default=100)
    parser.add_argument("--quick", action="store_true", help="9 problems")
    parser.add_argument("--fast-only", action="store_true", help="do not plan with FCL alone")
    arguments = parser.parse_args()
    count = 9 if arguments.quick else arguments.problems
    every: list[dict[str, Tally]] = []
    for number, scene in enumerate(scenes(count)):
        every.append(measure(scene, seed=1000 * number, fast_only=arguments.fast_only))
    if arguments.fast_only:
        return
    fast, slow = ([t for tallies in every for t in tallies[name].total_s] for name in (FAST, SLOW))
    print(f"\nall scenes: total {np.sum(slow) / np.sum(fast):.1f}x, median {np.median(slow) / np.median(fast):.1f}x")


def scenes(count: int) -> Iterator[Scene]:
    """The three rooms, a third of the problems each."""
    context, rng = prepare(folder() / "abdomen", arm=False), np.random.default_rng(0)
    assert context.placement is not None
    case, T_base_ct = context.case, context.placement.T_base_ct
    tool, home, skin = case_tool(case), home_configuration(case), context.anatomy.skin.mesh.transformed(T_base_ct)
    floor = np.eye(4)
    floor[2, 3] = -60.0
    boxes = case_boxes(case, T_base_ct)
    rooms = (
        ("free room", (Box("table", floor, (2000.0, 2000.0, 100.0)),), None),
        ("table and body", boxes, skin),
        ("beside a gantry", (*boxes, *gantry_boxes(gantry(context, T_base_ct), **GANTRY_MM)), skin),
    )
    for part, (name, room, patient) in enumerate(rooms):
        fast, slow, built = build(case.robot.model, tool, room, patient)
        start = next(q for q in (home, *FOLDED) if fast.contact(q, needle_may_touch_patient=False) is None)
        wanted = count // 3 + (part < count % 3)
        problems: list[tuple[np.ndarray, np.ndarray]] = []
        while len(problems) < wanted:
            found = between(fast, rng) if patient is None else to_a_puncture(fast, context, T_base_ct, start, rng)
            problems += [] if found is None else [found]
        yield Scene(name, fast, slow, built, room, patient, problems)


FOLDED = [np.radians([pan, -120.0, 130.0, -100.0, -90.0, 0.0]) for pan in range(-180, 180, 15)]
"""Where the arm waits where it cannot stand upright."""

GANTRY_MM = {"bore_diameter_mm": 800.0, "wall_mm": 120.0, "depth_mm": 250.0}


def gantry(context: CaseContext, T_base_ct: np.ndarray) -> np.ndarray:
    """T_base_gantry: about the body, its wall 225 to 475 mm from the target toward the head."""
    T_ct_gantry = np.eye(4)
    head = context.case.T_ct_entry[:3, 0]
    T_ct_gantry[:3, :3] = np.stack([*np.linalg.svd(head[None])[2][1:], head], axis=1)
    T_ct_gantry[:3, 0] *= np.sign(np.linalg.det(T_ct_gantry[:3, :3]))
    T_ct_gantry[:3, 3] = context.case.target_ct + 350.0 * head
    return T_base_ct @ T_ct_gantry


def build(
    model: UrModel, tool: Tool, boxes: tuple[Box, ...], patient: TriangleMesh | None
) -> tuple[FastChecker, CellChecker, tuple[float, float, float]]:
    """Both checkers, and the CPU seconds of: the fast one anew, the same from the cache, the plain one."""
    room = (model, tool, boxes, patient)
    with tempfile.TemporaryDirectory() as here:
        cache, times = Cache(Path(here)), list[float]()
        for _ in range(2):
            begin = process_time()
            fast = FastChecker(*room, padding_mm=ARM_PADDING_MM, cache=cache)
            times.append(process_time() - begin)
    begin = process_time()
    slow = CellChecker(*room, padding_mm=ARM_PADDING_MM)
    return fast, slow, (times[0], times[1], process_time() - begin)


def between(checker: FastChecker, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two free states anywhere."""
    states: list[np.ndarray] = []
    while len(states) < 2:
        q = rng.uniform(-np.pi, np.pi, 6)
        if checker.contact(q, needle_may_touch_patient=False) is None:
            states.append(q)
    return states[0], states[1][None]


def to_a_puncture(
    checker: FastChecker, context: CaseContext, T_base_ct: np.ndarray, home: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray] | None:
    """From the case's home to every pose that holds a direction from above; None where the arm holds none."""
    case = context.case
    u = rng.normal(size=3)
    u = u / np.linalg.norm(u) + 1.2 * case.T_ct_entry[:3, 2]
    outward = T_base_ct[:3, :3] @ (u / np.linalg.norm(u))
    target = T_base_ct[:3, :3] @ case.target_ct + T_base_ct[:3, 3]
    request = ReachRequest(target, outward / np.linalg.norm(outward), case.needle.length_mm, STANDOFF_MM)
    goals = approach_goals(checker, request, home)
    return (home, np.array([goal.insertion_q[0] for goal in goals])) if goals else None


def measure(scene: Scene, seed: int, fast_only: bool) -> dict[str, Tally]:
    """All problems of a scene with the fast checker, and with FCL alone where it is wanted."""
    checkers = {FAST: scene.fast} if fast_only else {FAST: scene.fast, SLOW: scene.slow}
    tallies = {name: Tally() for name in checkers}
    invalid, clearances, clearance_s, peaks, stops = 0, [], [], [], []
    home, goals = scene.problems[0]
    for checker in checkers.values():
        planned(checker, home, goals, seed, Tally())  # compiled, and warm
    for number, (home, goals) in enumerate(scene.problems):
        found = {name: planned(checkers[name], home, goals, seed + 50 * number, tallies[name]) for name in checkers}
        path = found[FAST]
        if path is None:
            continue
        q = dense_states(scene.fast, path.trajectory.q, RESOLUTION_RAD / FINER / 2.0)
        invalid += scene.slow.first_contact(q, needle_may_touch_patient=False) is not None
        begin = process_time()
        clearance = least_clearance(scene.fast, path.checked_q)
        clearance_s.append(process_time() - begin)
        clearances.append(min(nearest.mm for nearest in clearance))
        model, rates = scene.fast.model, path.trajectory.peaks()
        limits = (model.max_speeds, np.full(6, model.max_acceleration), np.full(6, MAX_JERK))
        peaks.append([float((rate / limit).max()) for rate, limit in zip(rates, limits, strict=True)])
        tip = TipLimit(scene.fast.tool.needle_length_mm, DEFAULT_SPEEDS.tip_speed_mm_s)
        stops.append(follow(slowed(model, DEFAULT_SPEEDS), path.waypoints, tip=tip).duration_s)
    report(scene, tallies, invalid)
    room = np.percentile(clearances, [0, 50])
    print(f"  clearance least {room[0]:.1f}, median {room[1]:.1f} mm (in {1e3 * np.median(clearance_s):.0f} ms)")
    print(f"  peaks over limits (speed, acceleration, jerk): {np.max(peaks, axis=0).round(4).tolist()}")
    print(
        f"  motion {np.median(tallies[FAST].drive_s):.2f} s (median);"
        f" with a stop at every corner {np.median(stops):.2f} s"
    )
    return tallies


def planned(checker: CellChecker, home: np.ndarray, goals: np.ndarray, seed: int, tally: Tally) -> Approach | None:
    """One plan, timed; None where there is none."""
    spent, search, asked = [0.0], approach._path, ()

    def timed(*arguments: Any) -> Any:
        nonlocal asked
        asked, begin = arguments, process_time()
        found = search(*arguments)
        spent[0] += process_time() - begin
        return found

    approach._path = timed  # measured from outside
    begin = process_time()
    try:
        path = plan_approach(checker, home, goals, seed=seed)
    except NoAnswerError as error:
        tally.refused.append(str(error))
        return None
    finally:
        approach._path = search
        tally.total_s.append(process_time() - begin)
        tally.solve_s.append(spent[0])
    poses = flange_pose(checker.model, path.trajectory.q)
    tips = poses[:, :3, 3] + checker.tool.needle_length_mm * poses[:, :3, 2]
    tally.rad.append(path_length(path.waypoints))
    tally.straight_rad.append(float(np.linalg.norm(goals - home, axis=1).min()))
    if np.isclose(tally.rad[-1], tally.straight_rad[-1]):
        begin = process_time()
        search(*asked)
        tally.straight_s.append((tally.solve_s[-1], process_time() - begin, tally.total_s[-1]))
    turned = float(np.ptp(path.waypoints, axis=0).max())
    tally.most_turned_rad = max(tally.most_turned_rad, turned - float(np.abs(goals[path.goal_index] - home).max()))
    tally.tip_mm.append(float(np.linalg.norm(np.diff(tips, axis=0), axis=1).sum()))
    tally.drive_s.append(path.trajectory.duration_s)
    return path


def report(scene: Scene, tallies: dict[str, Tally], invalid: int) -> None:
    """Print a scene's table."""
    anew, cached, plain = scene.built_s
    print(
        f"\n{scene.name}: {len(scene.problems)} problems, {np.mean([len(g) for _, g in scene.problems]):.0f} goals each"
    )
    print(f"  checkers built in {anew:.2f} s (from the cache {cached:.2f} s), FCL alone {plain:.2f} s")
    for name, tally in tallies.items():
        solve, total = (np.percentile(1e3 * np.array(times), [50, 95]) for times in (tally.solve_s, tally.total_s))
        straight = np.isclose(tally.rad, tally.straight_rad)
        print(
            f"  {name:9}: {len(tally.rad)} of {len(scene.problems)} solved, {straight.sum()} straight to the nearest"
            f" goal; solve {solve[0]:.1f} / {solve[1]:.1f} ms,"
            f" total {total[0]:.1f} / {total[1]:.1f} ms (median / 95 %); path {np.median(tally.rad):.2f} rad,"
            f" tip {np.median(tally.tip_mm):.0f} mm"
        )
        print(
            f"    joint travel {np.sum(tally.rad):.1f} rad in all, straight lines to the nearest goals"
            f" {np.sum(tally.straight_rad):.1f}; a joint turns by {np.degrees(tally.most_turned_rad):.0f} deg more than"
            " from end to end, at most"
        )
        if tally.straight_s:
            us = 1e6 * np.median(tally.straight_s, axis=0)
            print(
                f"    straight ones: {us[0]:.0f} us to a path ({us[1]:.0f} where the same was asked just before),"
                f" {us[2]:.0f} us to a checked motion (median)"
            )
        for why in tally.refused[:2]:
            print(f"    not: {why}")
    if SLOW in tallies:
        print(f"  total {np.sum(tallies[SLOW].total_s) / np.sum(tallies[FAST].total_s):.1f}x")
    print(f"  invalid paths {invalid}")


if __name__ == "__main__":
    main()
