"""Our approach and planners of others: mplib (OMPL and FCL in C++) and pybullet-planning, on the same problems.

    python benchmarks/approach_peers.py [--python PYTHON] [--problems N] [--seconds S]

They want an older numpy than the project, so they live in an environment of their own, whose Python is named here:

    python3 -m venv PEERS && PEERS/bin/pip install mplib==0.2.1 pybullet-planning==0.6.1

All judge the same bodies: the convex pieces of the links, holder and needle, without padding, the same boxes and the
same skin; the peers are first asked about states that FCL has judged. mplib takes a joint for the same a whole turn on
and may end there, so to all of them a goal is any that stands like it within the limits (pybullet-planning takes one:
the goal itself). What is timed is the search for a way and its shortcuts, in CPU seconds; the peers stop by the clock,
ours by counts. Every way is then checked by FCL alone, at states no more than 5 mrad and 2 mm of motion apart.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, beside the package

from benchmarks.approach import Scene, scenes
from puncture_twin.planning.arm.inverse_kinematics import wrapped_solutions
from puncture_twin.planning.collision.bodies import NEVER_TESTED
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.motion.path_check import dense_states, first_contact, path_length
from puncture_twin.planning.motion.rrt_connect import RANGE_RAD, Connected
from puncture_twin.planning.motion.shortest import MAX_SAMPLES, Task, shortest_path

Array = np.ndarray
RUNNER = Path(__file__).with_name("peer_planners.py")
CARRIED = {"holder": "wrist_3", "needle": "wrist_3"}
"""What the peers take for a part of the last link."""

STATES = 300
"""Asked about, so that it is the same room that they plan in."""

ITERATIONS = MAX_SAMPLES
"""Of pybullet-planning, beside its limit of time."""


def main() -> None:
    """Run all of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", default="", help="of the peers' environment")
    parser.add_argument("--problems", type=int, default=30)
    parser.add_argument("--seconds", type=float, default=10.0, help="the peers give up after so many")
    arguments = parser.parse_args()
    if not arguments.python:
        print(__doc__)
        return
    for number, scene in enumerate(scenes(arguments.problems)):
        compare(scene, number, arguments.python, arguments.seconds)


def compare(scene: Scene, number: int, python: str, seconds: float) -> None:
    """One room."""
    room = (scene.fast.model, scene.fast.tool, scene.boxes, scene.patient)
    fast, slow = FastChecker(*room), CellChecker(*room)
    scene.problems = [(home, turned(fast, goals)) for home, goals in scene.problems]
    print(f"\n{scene.name}: {len(scene.problems)} problems, without padding")
    ways, times = [], []
    ours(fast, *scene.problems[0], seed=0)
    for home, goals in scene.problems:
        begin = process_time()
        ways.append(ours(fast, home, goals, seed=1000 * number))
        times.append(process_time() - begin)
    report("ours", ways, times, slow)
    rng = np.random.default_rng(number)
    states = rng.uniform(-np.pi, np.pi, (STATES, 6))
    free = [slow.contact(q, needle_may_touch_patient=False) is None for q in states]
    for peer in ("mplib", "pybullet-planning"):
        if peer == "pybullet-planning" and scene.patient is not None:
            print(f"  {peer:18}: not asked; PyBullet's distances to a large open mesh are not to be trusted")
            continue
        answer = asked(peer, python, task(fast, scene, states, seconds))
        if isinstance(answer, str):
            print(f"  {peer:18}: did not run: {answer}")
            continue
        differ = sum(a != b for a, b in zip(free, answer["free"], strict=True))
        print(f"  {peer:18}: {differ} of {STATES} states judged otherwise than by FCL ({sum(free)} free)")
        found = [None if f["path"] is None else np.array(f["path"]) for f in answer["found"]]
        report(peer, found, [f["s"] for f in answer["found"]], slow)


def turned(checker: FastChecker, goals: Array) -> Array:
    """The goals and what stands like them, the goals first."""
    others = np.concatenate([wrapped_solutions(checker.model, goal) for goal in goals])
    away = np.abs(others[:, None] - goals).max(axis=2).min(axis=1)
    return np.concatenate([goals, others[away > 1e-6]])


def ours(checker: FastChecker, home: Array, goals: Array, seed: int) -> Array | None:
    """The search alone, as :func:`plan_approach` begins; None without a way."""
    found = shortest_path(Task(checker.model.joint_limits, checker.segment_checker(), home, goals), seed=seed)
    return None if isinstance(found, Connected) else found.waypoints


def report(name: str, ways: list[Array | None], times: list[float], judge: CellChecker) -> None:
    """One line: how many ways, how many of them touch something, how long it took, how long they are."""
    found = [way for way in ways if way is not None]
    touching = sum(first_contact(judge, dense_states(judge, way, 0.005)) is not None for way in found)
    length = np.median([path_length(way) for way in found]) if found else np.nan
    solve = 1e3 * np.percentile(times, [50, 95])
    print(
        f"  {name:18}: {len(found)} of {len(ways)} found, {touching} of them touch something; {solve[0]:.1f} /"
        f" {solve[1]:.1f} ms (median / 95 %), {np.sum(times):.2f} s in all; length {length:.2f} rad"
    )


def task(checker: FastChecker, scene: Scene, states: Array, seconds: float) -> dict[str, Any]:
    """A room and its problems in plain numbers. A URDF's link turns with its joint, before the DH frame is reached."""
    model, pieces = checker.model, {}
    after = [_dh(model.alpha[joint], model.a[joint], model.d[joint]) for joint in range(6)]
    for body in checker._bodies:
        T = (np.eye(4) if body.frame == 0 else after[body.frame - 1]) @ body.T_frame_body
        for hull in body.bare.hulls:
            corners = hull @ T[:3, :3].T + T[:3, 3]
            pieces.setdefault(CARRIED.get(body.name, body.name), []).append(_closed(corners))
    skin = scene.patient
    return {
        "origins": [_origin(np.eye(4)), *(_origin(T) for T in after[:-1])],
        "limits": model.joint_limits.tolist(),
        "pieces": pieces,
        "never": [pair for pair in NEVER_TESTED if not set(pair) & set(CARRIED)],
        "boxes": [{"T": box.T_base_box.tolist(), "size_mm": list(box.size_mm)} for box in scene.boxes],
        "skin": None if skin is None else {"corners": skin.vertices.tolist(), "faces": skin.faces.tolist()},
        "states": states.tolist(),
        "problems": [(home.tolist(), goals.tolist()) for home, goals in scene.problems],
        "seconds": seconds,
        "iterations": ITERATIONS,
        "range_rad": RANGE_RAD,
    }


def asked(peer: str, python: str, given: dict[str, Any]) -> dict[str, Any] | str:
    """A peer's answers, or why there are none."""
    with tempfile.TemporaryDirectory() as folder:
        task_file, answer_file = Path(folder) / "task.json", Path(folder) / "answer.json"
        task_file.write_text(json.dumps(given))
        run = subprocess.run(
            [python, RUNNER, peer, task_file, answer_file], capture_output=True, text=True, check=False
        )
        if not answer_file.is_file():
            return f"exit code {run.returncode}: {run.stderr.strip().splitlines()[-1:]}"
        answer: dict[str, Any] = json.loads(answer_file.read_text())
        return answer


def _dh(alpha: float, a: float, d: float) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([alpha, 0.0, 0.0]).as_matrix()
    T[:3, 3] = (a, 0.0, d)
    return T


def _origin(T: Array) -> list[float]:
    return [*T[:3, 3].tolist(), *Rotation.from_matrix(T[:3, :3]).as_euler("xyz").tolist()]


def _closed(corners: Array) -> dict[str, Any]:
    """A convex hull's corners and faces, outward."""
    hull = ConvexHull(corners)
    faces = hull.simplices.copy()
    a, b, c = (corners[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    used, faces = np.unique(faces, return_inverse=True)
    return {"corners": corners[used].tolist(), "faces": faces.reshape(-1, 3).tolist()}


if __name__ == "__main__":
    main()
