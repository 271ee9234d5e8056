"""Approaches in random workcells, each checked again by FCL alone at ten times the density of its own check.

    python -m tools.approach_attack --out FILE [--cells N] [--first K] [--problems M]

A workcell is three to eight boxes near a UR3 that stands on a table; home and three goals are free states anywhere. The
arm is planned with 5 mm of padding. A path is invalid where the arm without it touches something for FCL, or comes
nearer to a box than the padding less a millimetre, at states ten times denser than those that the planner's own check
looked at (distances at every tenth of them). Each workcell is one line of FILE; what is in it is not done again.

With --problems each workcell has so many, of one goal each, and every third one a gantry; a path is invalid where FCL
alone finds a contact of the padded arm at states 8 mm of motion apart: free ones prove that the arm without its 5 mm
meets no box between them either. That is a hundred times less to look at; use another FILE for it.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from puncture_twin.planning.arm.tool import Box, Tool, gantry_boxes
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.workcell import ARM_PADDING_MM
from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.planning.motion.approach import plan_approach
from puncture_twin.planning.motion.path_check import FINER, MAX_SWEEP_MM, RESOLUTION_RAD, dense_states, path_length

TOOL = Tool(needle_length_mm=200.0, shaft_mm=150.0, needle_diameter_mm=1.2, holder_diameter_mm=30.0)
DENSER = 10
EVERY = 10
"""Of the dense states the distance is measured at each so many; the arm moves 2 mm between two of them."""


SPARSE = 4
"""Of the states between which no body moves more than 2 mm, each so many are looked at where there are many problems:
no body is then farther than 4 mm from where it was looked at, which is less than the padding."""


def main() -> None:
    """Run what is not done, and say what all of it came to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cells", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--problems", type=int, default=0)
    arguments = parser.parse_args()
    done = {row["cell"]: row for row in rows(arguments.out)}
    for cell in range(arguments.first, arguments.first + arguments.cells):
        if cell not in done:
            done[cell] = many(cell, arguments.problems) if arguments.problems else attacked(cell)
            with arguments.out.open("a") as file:
                file.write(json.dumps(done[cell]) + "\n")
    (report_many if arguments.problems else report)(list(done.values()))


def rows(path: Path) -> list[dict[str, Any]]:
    """What was done before."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def attacked(cell: int) -> dict[str, Any]:
    """One workcell: planned, and what came of it."""
    rng = np.random.default_rng(cell)
    room = (ur_model("ur3"), TOOL, boxes(rng))
    checker, bare = FastChecker(*room, padding_mm=ARM_PADDING_MM), CellChecker(*room)
    states = free_states(checker, rng, 4)
    begin = process_time()
    try:
        path = plan_approach(checker, states[0], states[1:], seed=cell)
    except NoAnswerError as error:
        return {"cell": cell, "refused": str(error), "s": process_time() - begin}
    spent = process_time() - begin
    dense = dense_states(checker, path.trajectory.q, RESOLUTION_RAD / FINER / DENSER)
    touched = bare.first_contact(dense, needle_may_touch_patient=False)
    least = min(bare.nearest(q, "boxes").mm for q in dense[::EVERY])
    return {
        "cell": cell,
        "s": spent,
        "corners": len(path.waypoints) - 2,
        "states": len(dense),
        "rad": path_length(path.waypoints),
        "least_mm": least,
        "invalid": touched is not None or least < ARM_PADDING_MM - MAX_SWEEP_MM / 2.0,
    }


def many(cell: int, problems: int) -> dict[str, Any]:
    """Many problems in one workcell: how many were planned, and which of them are invalid."""
    rng, T_base_gantry = np.random.default_rng([cell, problems]), np.eye(4)
    T_base_gantry[:3, :3] = exp_rotation(rng.uniform(0.0, 0.3) * unit(rng)) @ exp_rotation([np.pi / 2.0, 0.0, 0.0])
    T_base_gantry[:3, 3] = rng.uniform((-100.0, -500.0, 100.0), (100.0, -300.0, 300.0))
    bore = gantry_boxes(T_base_gantry, bore_diameter_mm=800.0, wall_mm=120.0, depth_mm=200.0)
    room = (ur_model("ur3"), TOOL, [*boxes(rng), *(bore if cell % 3 == 0 else ())])
    checker, plain = (kind(*room, padding_mm=ARM_PADDING_MM) for kind in (FastChecker, CellChecker))
    begin, planned, states, invalid = process_time(), 0, 0, []
    for number in range(problems):
        home, goal = free_states(checker, rng, 2)
        try:
            path = plan_approach(checker, home, goal, seed=number)
        except NoAnswerError:
            continue
        dense = dense_states(plain, path.trajectory.q, RESOLUTION_RAD / FINER)
        looked_at = np.concatenate([dense[::SPARSE], dense[-1:]])
        planned, states = planned + 1, states + len(looked_at)
        if plain.first_contact(looked_at, needle_may_touch_patient=False) is not None:
            invalid.append(number)
    return {
        "cell": cell,
        "problems": problems,
        "planned": planned,
        "states": states,
        "invalid": invalid,
        "s": process_time() - begin,
    }


def report_many(done: list[dict[str, Any]]) -> None:
    """Print what all came to."""
    problems, planned, states = (sum(row[key] for row in done) for key in ("problems", "planned", "states"))
    invalid = [(row["cell"], number) for row in done for number in row["invalid"]]
    print(f"{len(done)} workcells, {problems} problems, {planned} paths, {problems - planned} refusals")
    print(f"invalid: {len(invalid)} {invalid[:10]}; {states} states; {sum(row['s'] for row in done):.0f} s")


def boxes(rng: np.random.Generator) -> list[Box]:
    """A table, and boxes of 5 to 400 mm within the arm's reach, turned anyhow, none about the base."""
    table = np.eye(4)
    table[2, 3] = -60.0
    found = [Box("table", table, (2000.0, 2000.0, 100.0))]
    while len(found) < 4 + rng.integers(6):
        T = np.eye(4)
        T[:3, :3] = exp_rotation(rng.uniform(0.0, np.pi) * unit(rng))
        T[:3, 3] = rng.uniform((-500.0, -500.0, 0.0), (500.0, 500.0, 600.0))
        if np.linalg.norm(T[:2, 3]) > 250.0:
            size = np.exp(rng.uniform(np.log(5.0), np.log(400.0), 3))
            found.append(Box(f"box_{len(found)}", T, (float(size[0]), float(size[1]), float(size[2]))))
    return found


def unit(rng: np.random.Generator) -> np.ndarray:
    """A direction."""
    u = rng.normal(size=3)
    return np.asarray(u / np.linalg.norm(u))


def free_states(checker: FastChecker, rng: np.random.Generator, count: int) -> np.ndarray:
    """Free states anywhere within half a turn, shape (count, 6), rad."""
    found: list[np.ndarray] = []
    while len(found) < count:
        q = rng.uniform(-np.pi, np.pi, 6)
        if checker.contact(q, needle_may_touch_patient=False) is None:
            found.append(q)
    return np.array(found)


def report(done: list[dict[str, Any]]) -> None:
    """Print what all came to."""
    paths = [row for row in done if "refused" not in row]
    invalid = [row["cell"] for row in paths if row["invalid"]]
    bent = sum(row["corners"] > 0 for row in paths)
    print(f"{len(done)} workcells, {len(paths)} paths ({bent} of them with corners), {len(done) - len(paths)} refusals")
    print(f"invalid: {len(invalid)} {invalid[:10]}; {sum(row['states'] for row in paths)} states")
    least = min((row["least_mm"] for row in paths), default=np.nan)
    print(f"least distance {least:.2f} mm, padding {ARM_PADDING_MM} mm")


if __name__ == "__main__":
    main()
